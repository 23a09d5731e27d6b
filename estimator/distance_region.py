"""The distance-region model (Eq. 10-12): exact nearest neighbours on a sorted distance axis.

Reference points are ordered by their distance from one centre, the place the sensor is believed to be (Eq. 10: the
"spatially adjacent sequence"). A query is inserted at its own distance, and the search walks from there to both ends of
the axis. It may stop as soon as the next distance differs from the query's by more than the best pair found so far,
because ``|r_p - r_q| <= |p - q|``: what has not been visited cannot be nearer, so the result is exact.

The plane around the centre may be cut into sectors, each with an axis of its own (ring x sector). A sector is skipped
when the ray that bounds it is farther away than the best pair: still exact, and a wall, which is a pile of equal
distances, is then spread over many short axes. One sector is the paper's single axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.kernel import kernel
from estimator.records import Array

Ints = npt.NDArray[np.int64]


@dataclass(slots=True, eq=False)
class Axis:
    """Reference points on their distance axis.

    Attributes:
        centre: (x, y) the distances are measured from.
        rows: (n, 3) points relative to the centre and their distance: x, y, r; ordered by sector, then by r.
        label: (n,) index of each row in the array the axis was built from.
        start: (sectors + 1,) first row of each sector.
        rays: (sectors + 1, 2) unit vectors of the sectors' bounds, counter-clockwise from +x.
    """

    centre: Array
    rows: Array
    label: Ints
    start: Ints
    rays: Array


def sector_count(points: int) -> int:
    """How many sectors make the search fastest for this many reference points."""
    if points < 64:
        return 1
    return int(min(2048, max(16, points // 2)))


def build_axis(points: Array, centre: Array, sectors: int = 0) -> Axis:
    """Order points of shape (n, 2) around ``centre``; ``sectors`` 0 chooses by their number."""
    n = len(points)
    count = sectors or sector_count(n)
    rows = np.empty((n, 3))
    label = np.empty(n, np.int64)
    start = np.zeros(count + 1, np.int64)
    rays = np.empty((count + 1, 2))
    order_points(np.ascontiguousarray(points), centre[0], centre[1], (rows, label, start, rays))
    return Axis(centre, rows, label, start, rays)


@kernel("f8(f8, f8)")
def turn_of(x: float, y: float) -> float:
    """A number in [0, 4) that grows with the angle of (x, y), one unit a quadrant; cheaper than an arctangent."""
    if y >= 0.0:
        if x > 0.0:
            return y / (x + y)
        return 1.0 - x / (y - x) if y > x else 0.0
    if x < 0.0:
        return 2.0 + y / (x + y)
    return 3.0 + x / (x - y)


@kernel("void(f8[:, ::1], i8[::1], i8, i8)")
def sort_rows(rows: Array, label: Ints, lo: int, hi: int) -> None:
    """Shell's sort of rows [lo, hi) by distance."""
    gap = 1
    while gap < (hi - lo) // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(lo + gap, hi):
            x, y, r, name = rows[i, 0], rows[i, 1], rows[i, 2], label[i]
            j = i
            while j >= lo + gap and rows[j - gap, 2] > r:
                rows[j, 0], rows[j, 1], rows[j, 2], label[j] = (
                    rows[j - gap, 0],
                    rows[j - gap, 1],
                    rows[j - gap, 2],
                    label[j - gap],
                )
                j -= gap
            rows[j, 0], rows[j, 1], rows[j, 2], label[j] = x, y, r, name
        gap //= 3


@kernel("void(f8[:, ::1], f8, f8, Tuple((f8[:, ::1], i8[::1], i8[::1], f8[:, ::1])))")
def order_points(points: Array, cx: float, cy: float, out: tuple[Array, Ints, Ints, Array]) -> None:
    """Eq. 10: counting sort into sectors, then by distance within each (Shell's sort; a sector holds a few points)."""
    rows, label, start, rays = out
    n = len(points)
    sectors = len(start) - 1
    for s in range(sectors + 1):
        turn = 4.0 * (s % sectors) / sectors
        quadrant = int(turn)
        f = turn - quadrant
        x, y = 1.0 - f, f
        for _ in range(quadrant):
            x, y = -y, x
        length = np.sqrt(x * x + y * y)
        rays[s, 0] = x / length
        rays[s, 1] = y / length
    home = np.empty(n, np.int64)
    for i in range(n):
        s = min(sectors - 1, int(turn_of(points[i, 0] - cx, points[i, 1] - cy) * 0.25 * sectors))
        home[i] = s
        start[s + 1] += 1
    for s in range(sectors):
        start[s + 1] += start[s]
    fill = start[:sectors].copy()
    for i in range(n):
        j = fill[home[i]]
        fill[home[i]] += 1
        x, y = points[i, 0] - cx, points[i, 1] - cy
        r = np.sqrt(x * x + y * y)
        label[j] = i
        rows[j, 0] = x
        rows[j, 1] = y
        rows[j, 2] = r
    for s in range(sectors):
        sort_rows(rows, label, start[s], start[s + 1])


@kernel("Tuple((i8, f8, f8))(f8[:, ::1], i8, i8, f8, f8, Tuple((f8, i8, f8, f8)))")
def nearest_on_axis(
    rows: Array, low: int, high: int, qx: float, qy: float, best: tuple[float, int, float, float]
) -> tuple[int, float, float]:
    """Walk the axis of rows [low, high) from the query's distance to both ends.

    ``best`` is (r_q, row, d2, e2): the query's own distance, the best row so far, its squared distance, and a bound
    that no other row comes closer than. Returns the last three, brought up to date.
    """
    rq, row, d2, e2 = best
    a, b = low, high
    while a < b:
        m = (a + b) >> 1
        if rows[m, 2] < rq:
            a = m + 1
        else:
            b = m
    up, down = a, a - 1
    while True:
        du = rows[up, 2] - rq if up < high else np.inf
        dd = rq - rows[down, 2] if down >= low else np.inf
        if du <= dd:
            if du * du >= d2:
                e2 = min(e2, du * du)
                break
            i = up
            up += 1
        else:
            if dd * dd >= d2:
                e2 = min(e2, dd * dd)
                break
            i = down
            down -= 1
        dx = rows[i, 0] - qx
        dy = rows[i, 1] - qy
        d = dx * dx + dy * dy
        if d < d2:
            e2 = min(e2, d2)
            d2 = d
            row = i
        else:
            e2 = min(e2, d)
    return row, d2, e2


@kernel("f8(f8[:, ::1], i8, f8, f8, f8)")
def ray_distance2(rays: Array, s: int, qx: float, qy: float, r2: float) -> float:
    """Squared distance of a query from the ray ``s``: beyond a right angle its nearest point is the centre."""
    ex, ey = rays[s, 0], rays[s, 1]
    if ex * qx + ey * qy <= 0.0:
        return r2
    cross: float = ex * qy - ey * qx
    return cross * cross


@kernel("Tuple((i8, f8, f8))(f8[:, ::1], i8[::1], f8[:, ::1], f8, f8, f8)")
def nearest(rows: Array, start: Ints, rays: Array, qx: float, qy: float, bound2: float) -> tuple[int, float, float]:
    """Row nearest to the query (relative to the centre), its squared distance, and a bound for all others' (squared).

    Row -1 and ``bound2`` if none is nearer than that. The bound makes a safe radius: until the query has moved by half
    the difference of the two distances, its nearest row cannot change.
    """
    r2 = qx * qx + qy * qy
    rq = np.sqrt(r2)
    sectors = len(start) - 1
    home = min(sectors - 1, int(turn_of(qx, qy) * 0.25 * sectors)) if sectors > 1 else 0
    row, d2, e2 = nearest_on_axis(rows, start[home], start[home + 1], qx, qy, (rq, -1, bound2, np.inf))
    left = right = home
    todo = sectors - 1
    open_left = open_right = todo > 0
    while open_left or open_right:
        if open_left:
            left = left + 1 if left + 1 < sectors else 0
            ray2 = ray_distance2(rays, left, qx, qy, r2)
            if ray2 >= d2:
                e2 = min(e2, ray2)
                open_left = False
            else:
                row, d2, e2 = nearest_on_axis(rows, start[left], start[left + 1], qx, qy, (rq, row, d2, e2))
                todo -= 1
                open_left = todo > 0
                open_right = open_right and todo > 0
        if open_right:
            ray2 = ray_distance2(rays, right, qx, qy, r2)
            right = right - 1 if right > 0 else sectors - 1
            if ray2 >= d2:
                e2 = min(e2, ray2)
                open_right = False
            else:
                row, d2, e2 = nearest_on_axis(rows, start[right], start[right + 1], qx, qy, (rq, row, d2, e2))
                todo -= 1
                open_right = todo > 0
                open_left = open_left and todo > 0
    return row, d2, e2


@kernel("void(f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8, Tuple((i8[::1], f8[::1], f8[::1])))")
def nearest_all(
    rows: Array, start: Ints, rays: Array, queries: Array, bound2: float, out: tuple[Ints, Array, Array]
) -> None:
    """:func:`nearest` for queries of shape (m, 2) relative to the centre."""
    row, d2, e2 = out
    for i in range(len(queries)):
        row[i], d2[i], e2[i] = nearest(rows, start, rays, queries[i, 0], queries[i, 1], bound2)


def query_axis(axis: Axis, queries: Array, bound: float = np.inf) -> tuple[Ints, Array]:
    """Label of the nearest reference point and its distance for each query (m, 2); -1 and ``bound`` where none."""
    row = np.empty(len(queries), np.int64)
    d2, e2 = np.empty(len(queries)), np.empty(len(queries))
    local = np.ascontiguousarray(queries - axis.centre)
    nearest_all(axis.rows, axis.start, axis.rays, local, bound * bound, (row, d2, e2))
    found = np.append(axis.label, -1)[row]
    return found, np.sqrt(d2)


def nearest_slow(points: Array, queries: Array, bound: float = np.inf) -> tuple[Ints, Array]:
    """The slow twin of :func:`query_axis`: every pair is compared."""
    found = np.full(len(queries), -1, np.int64)
    distance = np.full(len(queries), bound)
    for i, q in enumerate(queries):
        d = np.hypot(*(points - q).T)
        j = int(np.argmin(d)) if len(d) else -1
        if j >= 0 and d[j] < bound:
            found[i], distance[i] = j, d[j]
    return found, distance
