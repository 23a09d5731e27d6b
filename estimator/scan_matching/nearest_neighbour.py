"""Exact nearest-neighbour search on the ring x sector form of the distance axis.

Each sector of the axis (:mod:`estimator.scan_matching.distance_axis`) has its own axis. A sector is skipped when its
boundary ray is farther away than the best pair. The part of that ray inside the sector's ring gives a sharper test.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.scan_matching.distance_axis import GROUP, Axis, sector_of

GLANCE = 8
"""Rows that the first comparison covers, without a branch."""


SHORT = 64
"""A group of at most this many rows is compared in full; a longer one is searched along its axes."""


PATIENCE = 16
"""Points visited by a walk on a sector's axis; the rest is compared in full, which costs less per point."""


@kernel("Tuple((i8, f8, f8, i8, i8))(f8[:, ::1], i8, i8, i8, f8, f8, Tuple((i8, f8, f8, i8)))", inner=True)
def walk(
    rows: Array, low: int, high: int, at: int, qx: float, qy: float, best: tuple[int, float, float, int]
) -> tuple[int, float, float, int, int]:
    """Walk from ``at`` on the axis [low, high) to both ends; all rows before ``at`` are nearer to the origin.

    ``best``: best row so far, its squared distance, a lower bound (squared) for all others, and most rows to visit.
    Returns the first three, updated, and the next row towards each end.
    """
    row, d2, e2, most = best
    known = row
    rq = np.sqrt(qx * qx + qy * qy)
    up, down = at, at - 1
    while up - down <= most:
        du = rows[up, 2] - rq if up < high else np.inf
        dd = rq - rows[down, 2] if down >= low else np.inf
        gap = min(du, dd)
        if gap * gap >= d2:
            e2 = min(e2, gap * gap)
            break
        if du <= dd:
            i = up
            up += 1
        else:
            i = down
            down -= 1
        if i == known:
            continue
        dx, dy = rows[i, 0] - qx, rows[i, 1] - qy
        d = dx * dx + dy * dy
        if d < d2:
            e2 = min(e2, d2)
            d2 = d
            row = i
        else:
            e2 = min(e2, d)
    return row, d2, e2, down, up


@kernel("i8(f8[:, ::1], i8, i8, f8)", inner=True)
def place_on_axis(rows: Array, low: int, high: int, r: float) -> int:
    """First row of the axis [low, high) at a distance of at least ``r`` from the origin, by bisection."""
    while low < high:
        m = (low + high) >> 1
        if rows[m, 2] < r:
            low = m + 1
        else:
            high = m
    return low


@kernel("Tuple((i8, f8, f8))(f8[:, ::1], i8[::1], f8[:, ::1], f8, f8, f8)", inline=True)
def glance(rows: Array, start: Ints, rays: Array, qx: float, qy: float, bound2: float) -> tuple[int, float, float]:
    """Compare the few rows in the query's sector and beside it: row, squared distance, bound (squared) for all others.

    The result is final where the bound is not below the squared distance: then the outer rays are at least as far away.
    Otherwise :func:`search` has to continue.
    """
    sectors = len(start) - 1
    home = sector_of(qx, qy, sectors)
    a, b = max(home - 1, 0), min(home + 2, sectors)
    best, d2, e2 = -1.0, bound2, np.inf
    if start[b] - start[a] > GLANCE or len(rows) < GLANCE:
        return -1, bound2, -1.0
    low = min(start[a], len(rows) - GLANCE)
    for i in range(np.uint64(low), np.uint64(low + GLANCE)):
        dx, dy = rows[i, 0] - qx, rows[i, 1] - qy
        d = dx * dx + dy * dy
        e2 = min(e2, max(d, d2))
        best = float(i) if d < d2 else best  # as a float it stays free of branches
        d2 = min(d, d2)
    right = rays[a, 0] * qy - rays[a, 1] * qx
    left = rays[b, 0] * qy - rays[b, 1] * qx
    return int(best), d2, min(e2, min(right * right, left * left))


@kernel("Tuple((i8, f8, f8))(f8[:, ::1], i8, i8, f8, f8, Tuple((i8, f8, f8)))", inner=True)
def compare_through(
    rows: Array, low: int, high: int, qx: float, qy: float, best: tuple[int, float, float]
) -> tuple[int, float, float]:
    """Compare all rows [low, high) of an axis, four at a time, equal ones once; ``best`` as in :func:`walk`."""
    row, d2, e2 = best
    known = row
    if high > low and rows[low, 0] == rows[high - 1, 0] and rows[low, 1] == rows[high - 1, 1]:
        high = min(high, low + 2)  # rows between equal ones are equal; two give the distance and the bound
    whole = low + (high - low) // 4 * 4
    for i in range(low, whole, 4):
        least = np.inf
        for j in range(np.uint64(i), np.uint64(i + 4)):
            dx, dy = rows[j, 0] - qx, rows[j, 1] - qy
            least = min(least, dx * dx + dy * dy)
        if least < e2:
            for j in range(i, i + 4):
                d = (rows[j, 0] - qx) ** 2 + (rows[j, 1] - qy) ** 2
                if d < e2 and j != known:
                    e2 = max(d, d2)
                    row, d2 = (j, d) if d < d2 else (row, d2)
    for j in range(whole, high):
        d = (rows[j, 0] - qx) ** 2 + (rows[j, 1] - qy) ** 2
        if d < e2 and j != known:
            e2 = max(d, d2)
            row, d2 = (j, d) if d < d2 else (row, d2)
    return row, d2, e2


@kernel("Tuple((i8, f8, f8, i8))(f8[:, ::1], i8, i8, f8, f8, Tuple((i8, f8, f8)))", inner=True)
def search_axis(
    rows: Array, low: int, high: int, qx: float, qy: float, best: tuple[int, float, float]
) -> tuple[int, float, float, int]:
    """:func:`walk` along the axis [low, high) of one sector; rows at similar distances are compared in full."""
    row, d2, e2 = best
    rq = np.sqrt(qx * qx + qy * qy)
    at = place_on_axis(rows, low, high, rq)
    row, d2, e2, down, up = walk(rows, low, high, at, qx, qy, (row, d2, e2, PATIENCE))
    if up - down <= PATIENCE:
        return row, d2, e2, up - down - 1
    reach = np.sqrt(d2)
    first, last = place_on_axis(rows, low, down + 1, rq - reach), place_on_axis(rows, up, high, rq + reach)
    row, d2, e2 = compare_through(rows, first, down + 1, qx, qy, (row, d2, e2))
    row, d2, e2 = compare_through(rows, up, last, qx, qy, (row, d2, e2))
    if first > low:
        e2 = min(e2, (rq - rows[first - 1, 2]) ** 2)
    if last < high:
        e2 = min(e2, (rq - rows[last, 2]) ** 2)
    return row, d2, e2, last - first


@kernel("Tuple((i8, f8, f8, i8))(f8[:, ::1], i8[::1], i8, f8, f8, Tuple((i8, f8, f8)))", inline=True)
def search_group(
    rows: Array, start: Ints, group: int, qx: float, qy: float, best: tuple[int, float, float]
) -> tuple[int, float, float, int]:
    """Search the rows of a group of sectors, along each axis where they are many; ``best`` as in :func:`walk`."""
    row, d2, e2 = best
    first = GROUP * group
    last = min(first + GROUP, len(start) - 1)
    visits = start[last] - start[first]
    if visits > SHORT:
        visits = 0
        for s in range(first, last):
            row, d2, e2, n = search_axis(rows, start[s], start[s + 1], qx, qy, (row, d2, e2))
            visits += n
    else:
        known, at = row, float(row)
        for i in range(np.uint64(start[first]), np.uint64(start[last])):
            dx, dy = rows[i, 0] - qx, rows[i, 1] - qy
            d = dx * dx + dy * dy if i != known else np.inf
            e2 = min(e2, max(d, d2))
            at = float(i) if d < d2 else at
            d2 = min(d, d2)
        row = int(at)
    return row, d2, e2, visits


@kernel("Tuple((i8, f8, f8, i8))(f8[:, ::1], i8[::1], f8[:, ::1], f8, f8, i8, f8)", inner=True)
def search(
    rows: Array, start: Ints, rays: Array, qx: float, qy: float, row: int, d2: float
) -> tuple[int, float, float, int]:
    """Row nearest to the query (relative to the centre), given one at squared distance ``d2`` (row -1: only a bound).

    Returns row, squared distance, bound for all others (squared) and the number of rows visited. From the query's own
    group the search goes to both sides, until a ray is farther than the best pair. No ray is farther away than the
    centre. Where the centre is nearer than the best pair, bearings give no bound and only the rings do.
    """
    r2 = qx * qx + qy * qy
    sectors = len(start) - 1
    groups = (sectors + GROUP - 1) // GROUP
    home = sector_of(qx, qy, sectors) // GROUP
    if sectors == 1:  # the paper's form, one complete walk
        at = place_on_axis(rows, 0, len(rows), np.sqrt(r2))
        row, d2, e2, down, up = walk(rows, 0, len(rows), at, qx, qy, (row, d2, np.inf, len(rows) + 1))
        return row, d2, e2, up - down - 1
    row, d2, e2, visits = search_group(rows, start, home, qx, qy, (row, d2, np.inf))
    if d2 > r2:
        rq = np.sqrt(r2)
        for group in range(groups):
            off = max(rays[GROUP * group, 2] - rq, 0.0)
            if off * off >= d2 or group == home:
                e2 = min(e2, off * off) if group != home else e2
                continue
            row, d2, e2, n = search_group(rows, start, group, qx, qy, (row, d2, e2))
            visits += n
        return row, d2, e2, visits
    for side in range(1, -2, -2):
        group = home
        while True:
            ray = GROUP * group
            group += side
            if group == groups:
                group = 0
            elif group < 0:
                group = groups - 1
            if side > 0:
                ray = GROUP * group
            along = rays[ray, 0] * qx + rays[ray, 1] * qy
            across = rays[ray, 0] * qy - rays[ray, 1] * qx
            far2 = across * across if along > 0.0 else r2  # beyond a right angle the ray is nearest at the centre
            if far2 >= d2:
                e2 = min(e2, far2)
                break
            off = along - min(max(along, rays[GROUP * group, 2]), rays[GROUP * group, 3])
            far2 += off * off  # of that part of the ray that is inside the group's ring
            if far2 >= d2:
                e2 = min(e2, far2)
                continue
            row, d2, e2, n = search_group(rows, start, group, qx, qy, (row, d2, e2))
            visits += n
    return row, d2, e2, visits


@kernel("Tuple((i8, f8, f8))(f8[:, ::1], i8[::1], f8[:, ::1], f8, f8, f8)", inner=True)
def nearest(rows: Array, start: Ints, rays: Array, qx: float, qy: float, bound2: float) -> tuple[int, float, float]:
    """Row nearest to the query (relative to the centre), its squared distance, and a bound for all others' (squared).

    Row -1 and ``bound2`` if none is nearer than that.
    """
    row, d2, e2 = glance(rows, start, rays, qx, qy, bound2)
    if e2 < d2:
        row, d2, e2, _ = search(rows, start, rays, qx, qy, row, d2)
    return row, d2, e2


@kernel(
    "void(f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8, Tuple((i8[::1], f8[::1], f8[::1], i8[::1])))", aside=True
)
def nearest_all(
    rows: Array, start: Ints, rays: Array, queries: Array, bound2: float, out: tuple[Ints, Array, Array, Ints]
) -> None:
    """:func:`nearest` for queries (m, 2) relative to the centre, with the number of rows visited for each.

    Consecutive queries are close to each other, so the previous partner is the initial candidate.
    """
    row, d2, e2, visits = out
    last = -1
    for i in range(len(queries)):
        qx, qy = queries[i, 0], queries[i, 1]
        j, d, e = glance(rows, start, rays, qx, qy, bound2)
        n = GLANCE if e >= 0.0 else 0
        if e < d:
            if last >= 0:
                warm = (rows[last, 0] - qx) ** 2 + (rows[last, 1] - qy) ** 2
                if warm < d:
                    j, d = last, warm
            j, d, e, more = search(rows, start, rays, qx, qy, j, d)
            n += more
        row[i], d2[i], e2[i], visits[i] = j, d, e, n
        last = j


def query_axis(axis: Axis, queries: Array, bound: float = np.inf) -> tuple[Ints, Array, Ints]:
    """Label of the nearest reference point, its distance (m) and the number of points visited for each query (m, 2).

    Label -1 and distance ``bound`` where none is nearer than that.
    """
    row, visits = np.empty(len(queries), np.int64), np.empty(len(queries), np.int64)
    d2, e2 = np.empty(len(queries)), np.empty(len(queries))
    local = np.ascontiguousarray(queries - axis.centre)
    nearest_all(axis.rows, axis.start, axis.rays, local, bound * bound, (row, d2, e2, visits))
    return np.append(axis.label, -1)[row], np.sqrt(d2), visits


def nearest_slow(points: Array, queries: Array, bound: float = np.inf) -> tuple[Ints, Array]:
    """Brute-force reference implementation of :func:`query_axis`: every pair is compared."""
    found = np.full(len(queries), -1, np.int64)
    distance = np.full(len(queries), bound)
    for i, q in enumerate(queries):
        d = np.hypot(*(points - q).T)
        j = int(np.argmin(d)) if len(d) else -1
        if j >= 0 and d[j] < bound:
            found[i], distance[i] = j, d[j]
    return found, distance
