"""The distance-region model (Eq. 10-12): exact nearest neighbours on a sorted distance axis.

1. T1 transforms the new scan's points into the reference frame: the virtual frame S_new (Eq. 10, 11).
2. Reference and virtual points are sorted by their distance from the reference's origin and merged. This is the fused
sequence S_fus (Eq. 12, Fig. 2b), with the light points on the same axis.
3. From each virtual point ("the current data centre") the search walks to both ends of the axis. It stops when the next
distance differs from the point's own by more than the best pair. Because ``|r_p - r_q| <= |p - q|``, no unvisited point
can be nearer: the result is exact.

:func:`fuse` and :func:`pair_fused` are the paper's form, on a single axis. The points of a wall have similar distances,
and there the single axis visits many of them. In the ring x sector form (:mod:`estimator.scan_matching.distance_axis`)
each sector has its own axis. A sector is skipped when its boundary ray is farther away than the best pair. The part of
that ray inside the sector's ring gives a sharper test. This is exact too; see
:mod:`estimator.scan_matching.nearest_neighbour`.

Both forms also return a lower bound for the distance of every other point. The safe radius of a point is half the
difference between that bound and its partner's distance. Within it, a moved point keeps its partner without a search.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from estimator.numerics import se2
from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.scan_matching.distance_axis import Axis
from estimator.scan_matching.nearest_neighbour import walk


class Kind(IntEnum):
    """Kind of a point on the fused axis: circles, triangles and filled circles of Fig. 2b."""

    VIRTUAL = 0
    REFERENCE = 1
    LIGHT = 2


@dataclass(slots=True, eq=False)
class Fused:
    """S_fus (Eq. 12): virtual, reference and light points sorted by their distance from the reference's origin.

    Attributes:
        kind: (n,) :class:`Kind` of each entry on the axis.
        member: (n,) index among the points of that kind: rows of the axis, points of the new scan, or lights.
        distance: (n,) in m.
        virtual: (m, 2) the new scan's points relative to the axis centre, m.
        below: (m,) number of reference rows nearer to the origin than each of them: where its search begins.
        kept: (m,) whether it was measured within L.
        order: (m,) the virtual points by distance.
        rows: number of reference rows within L.
    """

    kind: npt.NDArray[np.uint8]
    member: Ints
    distance: Array
    virtual: Array
    below: Ints
    kept: npt.NDArray[np.bool_]
    order: Ints
    rows: int


def fuse(axis: Axis, points: Array, T: Array, far: float = np.inf, before: Fused | None = None) -> Fused:
    """Virtual frame and fused sequence (Eq. 11, 12) of the new scan's points (m, 2), in its lidar's frame.

    ``T``: pose of the new lidar in the axis' frame (x, y, yaw). ``far``: L of the quality filter. The axis is cut
    beyond L for reference points and beyond ``L + |t|`` for virtual ones. No virtual point beyond that can have been
    measured within L; the others are checked. ``before``: the sequence of the previous iteration, whose order is nearly
    the same.

    Raises:
        ValueError: the axis has sectors; the paper's form needs the single one (``build_axis(..., sectors=1)``).
    """
    if len(axis.start) != 2:
        raise ValueError(f"the fused axis is a single one, this has {len(axis.start) - 1} sectors; build it with one")
    virtual = np.ascontiguousarray(se2.apply(T, points) - axis.centre)
    r = np.hypot(virtual[:, 0], virtual[:, 1])
    order = np.argsort(r, kind="stable") if before is None else before.order[np.argsort(r[before.order], kind="stable")]
    cut = float(np.hypot(T[0] - axis.centre[0], T[1] - axis.centre[1])) + far
    reach = np.searchsorted(r, cut, side="right", sorter=order)
    kept = np.zeros(len(r), np.bool_)
    within = order[:reach]
    kept[within] = np.hypot(points[within, 0], points[within, 1]) <= far
    rows = int(np.searchsorted(axis.rows[:, 2], far, side="right"))
    lamp = np.argsort(axis.lights[:, 2], kind="stable")
    n = len(r) + len(axis.rows) + len(lamp)
    kind, member, distance = np.empty(n, np.uint8), np.empty(n, np.int64), np.empty(n)
    below = np.empty(len(r), np.int64)
    merge(r[order], order, axis.rows, axis.lights[lamp, 2], lamp, (kind, member, distance, below))
    return Fused(kind, member, distance, virtual, below, kept, order, rows)


@kernel(
    "void(f8[::1], i8[::1], f8[:, ::1], f8[::1], i8[::1], Tuple((u1[::1], i8[::1], f8[::1], i8[::1])))",
)
def merge(
    r: Array,
    order: Ints,
    rows: Array,
    shine: Array,
    lamp: Ints,
    out: tuple[npt.NDArray[np.uint8], Ints, Array, Ints],
) -> None:
    """Merge three sorted sequences into S_fus: virtual points ``r``, reference rows and lights ``shine``."""
    kind, member, distance, below = out
    v = p = k = 0
    for at in range(len(kind)):
        rv = r[v] if v < len(r) else np.inf
        rp = rows[p, 2] if p < len(rows) else np.inf
        rk = shine[k] if k < len(shine) else np.inf
        if p < len(rows) and rp <= rv and rp <= rk:
            kind[at], member[at], distance[at] = 1, p, rp
            p += 1
        elif v < len(r) and rv <= rk:
            kind[at], member[at], distance[at] = 0, order[v], rv
            below[order[v]] = p
            v += 1
        else:
            kind[at], member[at], distance[at] = 2, lamp[k], rk
            k += 1


@kernel("void(f8[:, ::1], f8[:, ::1], i8[::1], b1[::1], Tuple((i8[::1], f8[::1], i8[::1])))", aside=True)
def walk_all(
    rows: Array, virtual: Array, below: Ints, kept: npt.NDArray[np.bool_], out: tuple[Ints, Array, Ints]
) -> None:
    """:func:`walk` for all virtual points, each from its own position on the fused axis."""
    row, d2, visits = out
    n = len(rows)
    for i in range(len(virtual)):
        if kept[i]:
            at = min(below[i], n)
            row[i], d2[i], _, down, up = walk(rows, 0, n, at, virtual[i, 0], virtual[i, 1], (-1, d2[i], np.inf, n + 1))
            visits[i] = up - down - 1


def pair_fused(axis: Axis, fused: Fused, bound: float = np.inf) -> tuple[Ints, Array, Ints]:
    """Nearest reference row of each virtual point, its distance (m), and the number of points visited for it.

    Row -1 and distance ``bound`` where none is nearer than ``bound``, or where the point is beyond L.
    """
    m = len(fused.virtual)
    row, d2, visits = np.full(m, -1), np.full(m, bound * bound), np.zeros(m, np.int64)
    walk_all(axis.rows[: fused.rows], fused.virtual, fused.below, fused.kept, (row, d2, visits))
    return row, np.sqrt(d2), visits
