"""Relocalisation state between steps: hypothesis set, kidnap detection, and the last pose of the earlier map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.relocalisation.hypothesis_tracking import Seek, Suspicion


@dataclass(slots=True, eq=False)
class RelocalisationMemory:
    """State of relocalisation.

    Attributes:
        search: hypothesis set, while a part of the map is detached.
        suspicion: state of kidnap detection.
        unaligned: whether the restored map does not lie in the survey frame, and the robot has not been found in it.
        held: whether a part of the map is detached only because the robot may have been carried off: scans did not
            match for a while, and wheels were at rest. Wheels hold the pose until a search confirms another place.
        T_left, P_left: the last pose in the older map, and its covariance (3, 3; map axes) in the survey frame then.
        maps_dropped: number of stored maps dropped because the robot is nowhere in them.
    """

    search: Seek = field(default_factory=Seek)
    suspicion: Suspicion = field(default_factory=Suspicion)
    unaligned: bool = False
    held: bool = False
    T_left: Array = field(default_factory=se2.identity)
    P_left: Array = field(default_factory=lambda: np.zeros((3, 3)))
    maps_dropped: int = 0

    def forget(self) -> None:
        """Reset together with the map."""
        self.search, self.suspicion, self.unaligned, self.held = Seek(), Suspicion(), False, False
        self.T_left, self.P_left = se2.identity(), np.zeros((3, 3))
