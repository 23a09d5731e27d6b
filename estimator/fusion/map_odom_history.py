"""T_map_odom as it was a while ago: what light, under test since, is compared with (solution separation)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from estimator.numerics.arrays import Array

SPACING_M: Final = 10.0
"""Way between two snapshots: the older one in use is between one and two times as old."""


@dataclass(slots=True)
class MapOdomHistory:
    """At most two snapshots, the older first.

    Attributes:
        kept: T_map_odom, covariance of the pose (3, 3; map axes) and metres driven, of then.
    """

    kept: list[tuple[Array, Array, float]] = field(default_factory=list)

    def take(self, T_map_odom: Array, P: Array, way: float) -> None:
        """Keep a snapshot, if the newest is old enough."""
        if not self.kept or way - self.kept[-1][2] >= SPACING_M:
            self.kept.append((T_map_odom, P, way))
            del self.kept[:-2]

    def forget(self) -> None:
        """The place was found anew: what was before says nothing."""
        self.kept.clear()
