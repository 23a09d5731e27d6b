"""Scene change: sudden contradiction between consecutive scans, larger than moving objects can cause.

A robot put down where the surroundings look alike still matches, but not with every beam. Doors, niches and ends of
corridors are elsewhere. A surface that is now seen through, or a point in space that the previous scan saw free, shows
it. Moving objects show too, but over many scans: people walk and doors turn. So a scene change needs consistent scans
before and consistent scans afterwards. Each of the later ones must contradict the last of the earlier ones, a short
time before. Corners that open a view, and people who step before a wall, hide surfaces and contradict nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.measurements import Beams
from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.scan_matching.local_map import HIT, MARGIN, WIDTH, X, Y, look_at

Floats = npt.NDArray[np.float32]
Kinds = npt.NDArray[np.uint8]
LOUD, QUIET = 0.04, 0.005
"""Share of the evidence above which scans contradict each other, and below which they are consistent."""
CALM: Final = 3
"""Consecutive consistent scans required before and after."""
LEAST: Final = 40
"""Fewest points visible in both scans for a comparison."""
POINTS: Final = 200
"""Approximate number of compared points of a scan."""
LATEST_S: Final = 0.25
"""Longest time (s) from the last scan before to the first afterwards.

In 0.3 s a person beside the robot takes a step, and a door shuts. At 10 Hz there is time for one scan between, which
may show half of each position.
"""
SOONEST: Final = 0.5
"""Smallest time between two scans as a share of the usual one: stamps of scans in a burst are not their own."""


@kernel("void(f8[::1], f4[::1], u1[::1], f8[::1], f4[::1], u1[::1], f8, i8[::1])")
def compare(
    view: Array,
    reach: Floats,
    kind: Kinds,
    other: Array,
    reach_other: Floats,
    kind_other: Kinds,
    margin: float,
    told: Ints,
) -> None:
    """Count the points of a scan that another one sees through (``told[0]``), and those that it sees too (``[1]``).

    Each scan as in :class:`Glance`. ``margin``: see `local_map.look_at`.
    """
    hits = 0
    for i in range(len(kind)):
        hits += kind[i] == HIT
    stride = max(1, hits // POINTS)
    points = np.zeros(((hits + stride - 1) // stride, WIDTH))
    at = 0
    for i in range(len(kind)):
        if kind[i] == HIT:
            if at % stride == 0:
                angle = view[2] + view[3] + i * view[4]
                points[at // stride, X] = view[0] + reach[i] * np.cos(angle)
                points[at // stride, Y] = view[1] + reach[i] * np.sin(angle)
            at += 1
    bearing, distance = np.empty(len(kind_other)), np.empty(len(kind_other))
    for i in range(len(kind_other)):
        bearing[i], distance[i] = other[3] + i * other[4], reach_other[i]
    said = np.zeros(len(points), np.int8)
    look_at(points, other, (bearing, distance, kind_other), margin, 1, said)
    for i in range(len(said)):
        told[0] += said[i] < 0
        told[1] += said[i] > 0


@dataclass(frozen=True, slots=True, eq=False)
class Glance:
    """Compact scan signature at its matched pose: it is part of every checkpoint.

    Attributes:
        t_end: its end.
        view: (5,) x, y, yaw of the lidar in the odom frame, first bearing and angle from beam to beam.
        reach, kind: range in metres and kind (`measurements.Beam`) of each beam.
    """

    t_end: float
    view: Array
    reach: Floats
    kind: Kinds


def glance(t_end: float, eye: Array, beams: Beams) -> Glance:
    """Signature of a scan that ended at ``t_end``, seen from ``eye`` (x, y, yaw); bearings are evenly spaced."""
    bearing, reach, kind = beams
    each = (bearing[-1] - bearing[0]) / max(1, len(bearing) - 1) if len(bearing) else 0.0
    first = bearing[0] if len(bearing) else 0.0
    return Glance(t_end, np.array((*eye, first, each)), reach.astype(np.float32), kind)


@dataclass(slots=True, eq=False)
class Leap:
    """State of the scene change detection.

    Attributes:
        latest: the newest scan.
        alike: number of consecutive consistent scans, up to the newest.
        t_first: end of the first of them.
        calm: the newest scan of an earlier, long enough series; the newest of all while nothing changes.
        loud: number of consecutive latest scans that contradict it more than moving objects can.
        seen: whether a scene change has just occurred.
    """

    latest: Glance | None = None
    alike: int = 0
    t_first: float = 0.0
    calm: Glance | None = None
    loud: int = 0
    seen: bool = False

    def take(self, now: Glance, noise_m: float, usual_s: float) -> None:
        """Add a scan that matched; ``usual_s``: usual time between two scans."""
        before = self.latest or now
        in_time = SOONEST * usual_s < now.t_end - before.t_end < LATEST_S
        share = differs(before, now, noise_m)
        if share > QUIET or not in_time:
            self.alike, self.t_first = 0, now.t_end
        self.alike += 1
        if self.calm is not None and self.alike <= CALM:
            share = share if self.calm is before else differs(self.calm, now, noise_m)
            self.loud = self.loud + 1 if share >= LOUD else 0
        self.latest, self.seen = now, False
        if self.alike >= CALM:
            soon = self.calm is not None and 0.0 < self.t_first - self.calm.t_end < LATEST_S
            self.seen = soon and self.loud >= CALM
            self.calm, self.loud = now, 0

    def forget(self) -> None:
        """Clear all scans."""
        self.latest, self.calm, self.alike, self.loud, self.seen = None, None, 0, 0, False


def differs(one: Glance, other: Glance, noise_m: float) -> float:
    """Share of the evidence by which two scans contradict each other, in both directions; 0 with too little of it."""
    told, margin = np.zeros(2, np.int64), MARGIN + 5.0 * noise_m
    for a, b in ((one, other), (other, one)):
        compare(a.view, a.reach, a.kind, b.view, b.reach, b.kind, margin, told)
    through, there = told.tolist()
    return through / (through + there) if through + there >= LEAST else 0.0
