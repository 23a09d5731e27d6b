"""The distance axis (Eq. 10): reference points sorted by distance from a centre, in one sequence or in sectors.

The single axis is the paper's "spatially adjacent sequence". The ring x sector form divides the plane around the centre
into sectors. Each sector has its own axis, one after the other in the same array. Each group of ``GROUP`` neighbouring
sectors also stores its ring: the distances of its nearest and its farthest point. A scan is ordered by bearing, so
sorting it into sectors moves few points.

Light points (lamps in the frame of the reference keyframe, Fig. 2b) lie on the axis beside the surface points. They are
stored separately from the searched rows, so no lidar point can be paired with one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel

GROUP = 8
"""Sectors that share a ring."""

FEWEST = 32
"""Fewest sectors, where there are any: a group must not span more than a right angle."""

ONE_AXIS = 16
"""Fewer points than this are searched on the single axis (measured: docs/estimator.md)."""


@dataclass(slots=True, eq=False)
class Axis:
    """Reference points on their distance axis.

    Attributes:
        centre: (x, y) from which the distances are measured, m.
        rows: (n, 3) points relative to the centre and their distance: x, y, r in m; ordered by sector, then by r.
        label: (n,) index of each row in the array from which the axis was built.
        start: (sectors + 1,) first row of each sector. One sector is the paper's single axis.
        rays: (sectors + 1, 4) unit vector of each sector's first boundary, counter-clockwise from +x. Where a group of
            sectors begins, columns 2 and 3 hold the distances of its nearest and farthest point.
        lights: (k, 3) light points relative to the centre and their distance, in the order given.
    """

    centre: Array
    rows: Array
    label: Ints
    start: Ints
    rays: Array
    lights: Array = field(default_factory=lambda: np.empty((0, 3)))


def sector_count(points: int) -> int:
    """Number of sectors for the fastest search of this many reference points: two points in each, over 270 deg."""
    return min(8192, max(FEWEST, 2 * points // 48 * 16)) if points >= ONE_AXIS else 1


def build_axis(points: Array, centre: Array, sectors: int = 0, lights: Array | None = None) -> Axis:
    """Build the axis of points (n, 2) around ``centre``; ``sectors`` 0 selects the count from the number of points.

    ``lights``: (k, 2) light points in the same frame.

    Raises:
        ValueError: more than one sector, but fewer than ``FEWEST``.
    """
    n = len(points)
    if 1 < sectors < FEWEST:
        raise ValueError(f"{sectors} sectors are too wide to be searched; use 1, {FEWEST} or more, or 0 to choose")
    rays = np.empty(((sectors or sector_count(n)) + 1, 4))
    bound_sectors(rays)
    rows, label, start = np.empty((n, 3)), np.empty(n, np.int64), np.zeros(len(rays), np.int64)
    order_points(np.ascontiguousarray(points), centre[0], centre[1], (rows, label, start, rays))
    if lights is None or not len(lights):
        return Axis(centre, rows, label, start, rays)
    at = lights - centre
    return Axis(centre, rows, label, start, rays, np.column_stack((at, np.hypot(at[:, 0], at[:, 1]))))


@kernel("void(f8[:, ::1])")
def bound_sectors(rays: Array) -> None:
    """Write the boundaries of equal sectors (by :func:`turn_of`) to ``Axis.rays``, with empty rings."""
    sectors = len(rays) - 1
    for s in range(sectors + 1):
        turn = 4.0 * (s % sectors) / sectors
        quarter, f = int(turn), turn % 1.0
        x = (1.0 - f, -f, f - 1.0, f)[quarter]
        y = (f, 1.0 - f, -f, f - 1.0)[quarter]
        length = np.sqrt(x * x + y * y)
        rays[s, 0], rays[s, 1] = x / length, y / length
        rays[s, 2], rays[s, 3] = np.inf, -np.inf


@kernel("f8(f8, f8)", inline=True)
def turn_of(x: float, y: float) -> float:
    """Pseudo-angle of (x, y) in [0, 4): it grows with the angle, one unit a quadrant; cheaper than an arctangent."""
    if y >= 0.0:
        if x > 0.0:
            return y / (x + y)
        return 1.0 - x / (y - x) if y > x else 0.0
    if x < 0.0:
        return 2.0 + y / (x + y)
    return 3.0 + x / (x - y)


@kernel("i8(f8, f8, i8)", inline=True)
def sector_of(x: float, y: float, sectors: int) -> int:
    """Index of the sector of a point relative to the centre."""
    return max(0, min(sectors - 1, int(turn_of(x, y) * 0.25 * sectors)))


@kernel("f8(f8[:, ::1], i8, f8, f8, f8)", inner=True)
def ray_distance2(rays: Array, s: int, qx: float, qy: float, r2: float) -> float:
    """Squared distance of a query from the ray ``s``; beyond a right angle its nearest point is the centre."""
    if rays[s, 0] * qx + rays[s, 1] * qy <= 0.0:
        return r2
    cross: float = rays[s, 0] * qy - rays[s, 1] * qx
    return cross * cross


@kernel("b1(f8[::1], f8, f8, f8)", inline=True)
def is_behind(row: Array, x: float, y: float, r: float) -> bool:
    """Whether a row comes after (x, y, r) on its axis."""
    if row[2] != r:
        return bool(row[2] > r)
    return bool(row[0] > x or (row[0] == x and row[1] > y))


@kernel("void(f8[:, ::1], i8[::1], i8, i8)", inner=True)
def sort_rows(rows: Array, label: Ints, lo: int, hi: int) -> None:
    """Shell sort of rows [lo, hi) by distance, then by x and y, so that equal points are adjacent."""
    gap = 1
    while gap < (hi - lo) // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(lo + gap, hi):
            x, y, r, name = rows[i, 0], rows[i, 1], rows[i, 2], label[i]
            j = i
            while j >= lo + gap and is_behind(rows[j - gap], x, y, r):
                rows[j, 0], rows[j, 1] = rows[j - gap, 0], rows[j - gap, 1]
                rows[j, 2], label[j] = rows[j - gap, 2], label[j - gap]
                j -= gap
            rows[j, 0], rows[j, 1], rows[j, 2], label[j] = x, y, r, name
        gap //= 3


@kernel("void(f8[:, ::1], f8, f8, Tuple((f8[:, ::1], i8[::1], i8[::1], f8[:, ::1])))")
def order_points(points: Array, cx: float, cy: float, out: tuple[Array, Ints, Ints, Array]) -> None:
    """Eq. 10: counting sort into sectors, then a Shell sort by distance within each sector of a few points."""
    rows, label, start, rays = out
    n = len(points)
    sectors = len(start) - 1
    home = np.empty(n, np.int64)
    for i in range(n):
        s = sector_of(points[i, 0] - cx, points[i, 1] - cy, sectors)
        home[i] = s
        start[s + 1] += 1
    for s in range(sectors):
        start[s + 1] += start[s]
    fill = start[:sectors].copy()
    for i in range(n):
        s = home[i]
        j = fill[s]
        fill[s] += 1
        x, y = points[i, 0] - cx, points[i, 1] - cy
        r = np.sqrt(x * x + y * y)
        label[j] = i
        rows[j, 0], rows[j, 1], rows[j, 2] = x, y, r
        group = s // GROUP * GROUP
        rays[group, 2] = min(rays[group, 2], r)
        rays[group, 3] = max(rays[group, 3], r)
    for s in range(sectors):
        if start[s + 1] - start[s] > 1:
            sort_rows(rows, label, start[s], start[s + 1])
