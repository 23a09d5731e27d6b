"""T_map_odom history: two earlier corrections, from which the lidar solution of the solution separation starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from estimator.numerics.arrays import Array

SPACING_M: Final = 10.0
"""Path length between two snapshots, m: the age of the older one is between one and two times that."""


@dataclass(slots=True)
class MapOdomHistory:
    """At most two snapshots, the older first.

    Attributes:
        kept: T_map_odom, covariance of the pose (3, 3; map axes) and path length (m) of each snapshot.
    """

    kept: list[tuple[Array, Array, float]] = field(default_factory=list)

    def take(self, T_map_odom: Array, P: Array, way: float) -> None:
        """Keep a snapshot, if the newest is old enough."""
        if not self.kept or way - self.kept[-1][2] >= SPACING_M:
            self.kept.append((T_map_odom, P, way))
            del self.kept[:-2]

    def forget(self) -> None:
        """Remove the snapshots, after the pose was found again."""
        self.kept.clear()
