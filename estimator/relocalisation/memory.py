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
        dead_reckoning: whether a part of the map is detached only because there was an opportunity for a kidnapping
            before the local map restarted. Odometry carries the pose until a search confirms another place.
        T_left, P_left: the last pose in the older map, and its covariance (3, 3; map axes) in the survey frame then.
        maps_dropped: number of stored maps dropped because the robot is nowhere in them.
    """

    search: Seek = field(default_factory=Seek)
    suspicion: Suspicion = field(default_factory=Suspicion)
    unaligned: bool = False
    dead_reckoning: bool = False
    T_left: Array = field(default_factory=se2.identity)
    P_left: Array = field(default_factory=lambda: np.zeros((3, 3)))
    maps_dropped: int = 0

    def forget(self) -> None:
        """Reset together with the map."""
        self.search, self.suspicion = Seek(), Suspicion()
        self.unaligned = self.dead_reckoning = False
        self.T_left, self.P_left = se2.identity(), np.zeros((3, 3))
