"""What is a right loop, by the simulator's truth: never by an optimised map of our own.

A pair of keyframes is *positive* if they were truly laid within 0.5 m and 30 deg of each other, with 10 m of way
between them, or if half of what the new one sees was seen from the old stretch. A detection is an accepted constraint
from a keyframe to an earlier submap. It is *right* if the keyframe and some keyframe of that submap are a positive
pair, and the relative pose is within 0.20 m and 1 deg of the truth (strict: 0.15 m and 0.02 rad). Precision is right
detections by all; recall is the share of the queries which have a near positive that got a right detection.
"""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from estimator.mapping.keyframe import Keyframe
from estimator.measurements import Beam
from estimator.numerics import se2
from tools.sim.building.world import Array
from tools.sim.light.link_drive import LightRun

NEAR_M: Final = 0.5
NEAR_RAD: Final = math.radians(30.0)
APART_M: Final = 10.0
RIGHT: Final = (0.20, math.radians(1.0))
STRICT: Final = (0.15, 0.02)
SEEN_M: Final = 0.1
"""Cells in which two beams have seen the same."""
OVERLAP: Final = 0.5


@dataclass(slots=True, eq=False)
class Truth:
    """Where keyframes were truly laid, by ID, with the way driven until then, and what they truly saw."""

    run: LightRun
    pose: dict[int, Array] = field(default_factory=dict)
    way: dict[int, float] = field(default_factory=dict)
    member: dict[int, list[int]] = field(default_factory=dict)
    seen: dict[int, set[tuple[int, int]]] = field(default_factory=dict)

    def laid(self, frame: Keyframe, t: float) -> None:
        """Take down a keyframe of an instant."""
        at = np.array([t])
        self.pose[frame.key] = self.run.truth(at)[0]
        self.way[frame.key] = float(self.run.drive.travelled(at)[0])
        self.member.setdefault(frame.submap.key, []).append(frame.key)
        bearing, reach, kind = frame.beams()
        hit = (kind == Beam.HIT) & (reach > 0.0)
        x, y, yaw = se2.compose(self.pose[frame.key], frame.T_base_lidar).tolist()
        cells = np.column_stack((x + reach * np.cos(yaw + bearing), y + reach * np.sin(yaw + bearing)))[hit]
        self.seen[frame.key] = set(map(tuple, np.floor(cells / SEEN_M).astype(int).tolist()))

    def near(self, new: int, old: int) -> bool:
        """Whether two keyframes were laid at one place, with way between them."""
        x, y, yaw = se2.between(self.pose[old], self.pose[new]).tolist()
        return math.hypot(x, y) <= NEAR_M and abs(yaw) <= NEAR_RAD and self.way[new] - self.way[old] >= APART_M

    def has_positive(self, new: int) -> bool:
        """Whether any earlier keyframe is near."""
        return any(self.near(new, old) for old in self.pose if old < new)

    def positive(self, new: int, submap: int) -> bool:
        """Whether the keyframe and the submap truly see the same."""
        old = [key for key in self.member[submap] if self.way[new] - self.way[key] >= APART_M]
        return any(self.near(new, key) for key in old) or self.overlap(new, old) >= OVERLAP

    def overlap(self, new: int, old: list[int]) -> float:
        """Share of what a keyframe sees that was seen, within a cell, from others."""
        known: set[tuple[int, int]] = set()
        for key in old:
            known |= self.seen[key]
        mine = self.seen[new]
        around = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        return sum(any((c + i, r + j) in known for i, j in around) for c, r in mine) / max(1, len(mine))

    def off(self, new: int, first: int, T_first_new: Array) -> tuple[float, float]:
        """By how much (m, rad) a relative pose is wrong."""
        x, y, yaw = se2.between(se2.between(self.pose[first], self.pose[new]), T_first_new).tolist()
        return math.hypot(x, y), abs(yaw)
