"""Upper bound on the relative covariance of two submaps: the minimum-trace path through the pose graph (Dijkstra).

The graph's own marginals are relative to its start. After a loop closure far from there, the robot's surroundings
are known, but not their position relative to the start. Covariances of relative poses add up along a path once each is
propagated to one position. That propagation is linear (`se2.carry`), so Dijkstra finds the path with the smallest trace
to every submap. All other paths are ignored, so the result is an upper bound.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.mapping.pose_graph import Graph
from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel

BELIEVED: Final = 0.25
"""Smallest weight of a loop that can be part of a path."""

UNTIED: Final = 1e4
"""Variance (m^2, rad^2) of a submap without a path."""


def tied(graph: Graph, poses: Array, trust: Array, to: int) -> Array:
    """(n, 3, 3) covariance, map axes, of pose ``to`` relative to each of ``poses``; ``trust``: weight of each edge."""
    used = np.flatnonzero(trust > BELIEVED)
    edges = np.ascontiguousarray(graph.edges[used])
    carried = carried_to(poses[to], poses[edges[:, 1]], graph.information[used])
    start, order = rows_of(len(poses), edges)
    out = np.empty((len(poses), 3, 3))
    surest(to, edges, carried, (start, order), out)
    return out


def carried_to(there: Array, at: Array, information: Array) -> Array:
    """(m, 3, 3) covariances, map axes, of edges that end at poses ``at`` (m, 3), propagated to the pose ``there``."""
    H = information[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(-1, 3, 3)
    P = inverse3(H)
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    A = np.zeros((len(at), 3, 3))
    A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1], A[:, 2, 2] = c, -s, s, c, 1.0
    A[:, 0, 2], A[:, 1, 2] = at[:, 1] - there[1], there[0] - at[:, 0]
    return np.ascontiguousarray(A @ P @ A.transpose(0, 2, 1))


def inverse3(H: Array) -> Array:
    """Inverses of (m, 3, 3) symmetric matrices, by their adjugates."""
    a, b, c = H[:, 0], H[:, 1], H[:, 2]
    adjugate = np.stack((np.cross(b, c), np.cross(c, a), np.cross(a, b)), axis=2)
    return np.asarray(adjugate / np.einsum("ij,ij->i", a, adjugate[:, :, 0])[:, None, None])


def rows_of(n: int, edges: Ints) -> tuple[Ints, Ints]:
    """For each pose the start of its edges, and the edges, in compressed rows."""
    ends = edges.T.ravel()
    order = np.argsort(ends, kind="stable")
    start = np.searchsorted(ends[order], np.arange(n + 1))
    return start, order % max(1, len(edges))


@kernel("void(i8, i8[:, ::1], f8[:, :, ::1], UniTuple(i8[::1], 2), f8[:, :, ::1])", aside=True)
def surest(to: int, edges: Ints, carried: Array, rows: tuple[Ints, Ints], out: Array) -> None:
    """Dijkstra from ``to`` with the trace of the covariance as path length; writes the covariances to ``out``."""
    start, order = rows
    n = len(out)
    far, done = np.full(n, np.inf), np.zeros(n, np.bool_)
    for i in range(n):
        for r in range(3):
            for c in range(3):
                out[i, r, c] = UNTIED if r == c else 0.0
    heap_key, heap_node = np.empty(2 * len(order) + 2), np.empty(2 * len(order) + 2, np.int64)
    far[to], heap_key[0], heap_node[0], count = 0.0, 0.0, to, 1
    out[to] = 0.0
    while count > 0:
        i = heap_node[0]
        count -= 1
        key, node = heap_key[count], heap_node[count]
        k = 0
        while True:  # sift the last one down from the top
            child = 2 * k + 1
            if child >= count:
                break
            if child + 1 < count and heap_key[child + 1] < heap_key[child]:
                child += 1
            if heap_key[child] >= key:
                break
            heap_key[k], heap_node[k] = heap_key[child], heap_node[child]
            k = child
        heap_key[k], heap_node[k] = key, node
        if done[i]:
            continue
        done[i] = True
        for e in order[start[i] : start[i + 1]]:
            j = edges[e, 0] + edges[e, 1] - i
            length = far[i] + carried[e, 0, 0] + carried[e, 1, 1] + carried[e, 2, 2]
            if done[j] or length >= far[j]:
                continue
            far[j] = length
            for r in range(3):
                for c in range(3):
                    out[j, r, c] = out[i, r, c] + carried[e, r, c]
            k = count
            count += 1
            while k > 0 and heap_key[(k - 1) >> 1] > length:
                heap_key[k], heap_node[k] = heap_key[(k - 1) >> 1], heap_node[(k - 1) >> 1]
                k = (k - 1) >> 1
            heap_key[k], heap_node[k] = length, j
