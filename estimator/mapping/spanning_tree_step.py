"""Gauss-Newton step of the pose graph in relative coordinates along a spanning tree.

The normal equations give a small displacement of each pose in the map's axes. Added to the poses, it distorts a long
chain that rotates by much: one rotation moves far poses along a straight line instead of a circle. Here the step
changes each pose relative to its parent in the tree. Then the edges of the tree get exactly the error that the
equations predict. Only loops are affected by the curvature (cf. Olson, Leonard, Teller, ICRA 2006; Grisetti et al., RSS
2007, who optimise in such coordinates altogether).
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Bools, Ints
from estimator.numerics.elimination_ordering import NONE, adjacency
from estimator.numerics.jit import kernel


@kernel("Tuple((i8[::1], i8[::1]))(i8, i8[:, ::1], b1[::1], b1[::1])", aside=True)
def spanning(n: int, edges: Ints, doubtful: Bools, free: Bools) -> tuple[Ints, Ints]:
    """Spanning tree over the edges that are not doubtful: poses by distance from its roots, and the parent of each.

    Poses that are not free are roots. So is the first pose of each component without one; a root's parent is ``NONE``.
    """
    sure = np.empty((len(edges), 2), np.int64)
    count = 0
    for k in range(len(edges)):
        if not doubtful[k]:
            sure[count] = edges[k]
            count += 1
    first, near = adjacency(n, sure[:count])
    order, parent, reached = np.empty(n, np.int64), np.full(n, NONE), ~free
    end = 0
    for i in range(n):
        if reached[i]:
            order[end] = i
            end += 1
    at = 0
    for root in range(n + 1):
        while at < end:
            i = order[at]
            at += 1
            for m in range(first[i], first[i + 1]):
                j = near[m]
                if not reached[j]:
                    reached[j], parent[j] = True, i
                    order[end] = j
                    end += 1
        if root < n and not reached[root]:
            reached[root] = True
            order[end] = root
            end += 1
    return order, parent


@kernel("void(f8[:, ::1], f8[:, ::1], i8[::1], Tuple((i8[::1], i8[::1])), f8[:, ::1])", inner=True)
def carry_on(poses: Array, step: Array, place: Ints, tree: tuple[Ints, Ints], out: Array) -> None:
    """Write ``poses`` after ``step`` to ``out`` (n, 3); ``step`` is indexed by ``place``, negative for a held pose."""
    order, parent = tree
    for at in range(len(order)):
        j = order[at]
        i, row = parent[j], place[j]
        dx = dy = turn = 0.0
        if row >= 0:
            dx, dy, turn = step[row, 0], step[row, 1], step[row, 2]
        if i < 0:  # a root moves along an arc
            half = 0.5 * turn
            chord = np.sin(half) / half if abs(half) > 1e-8 else 1.0
            c, s = chord * np.cos(half), chord * np.sin(half)
            out[j, 0] = poses[j, 0] + c * dx - s * dy
            out[j, 1] = poses[j, 1] + s * dx + c * dy
            out[j, 2] = poses[j, 2] + turn
            continue
        before = 0.0
        if place[i] >= 0:
            before = step[place[i], 2]
            dx -= step[place[i], 0]
            dy -= step[place[i], 1]
        x, y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        dx += before * y
        dy -= before * x
        change = out[i, 2] - poses[i, 2]
        c, s = np.cos(change), np.sin(change)
        out[j, 0] = out[i, 0] + c * (x + dx) - s * (y + dy)
        out[j, 1] = out[i, 1] + s * (x + dx) + c * (y + dy)
        out[j, 2] = out[i, 2] + poses[j, 2] - poses[i, 2] + turn - before
