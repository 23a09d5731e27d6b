"""Pose-graph sparsification: selects the edges to keep where the same area has been driven through many times.

A submap that is removed passes its edges to a neighbour. So after many laps each submap would have an edge to every
other. The edges with the smallest covariance contain nearly all information. The others cost memory and time in every
solution of the graph.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.mapping.constraints import Constraints
from estimator.mapping.pose_graph_kernels import spanning
from estimator.numerics.arrays import Array, Bools, Ints
from estimator.numerics.elimination_ordering import NONE

WAYS, LOOPS = 2, 4
"""Odometry edges and loop edges that a submap keeps for itself; the other end may keep more."""

SLACK: Final = 1.25
"""Sparsification starts at so many times more edges, not at every single one."""


def thinned(keys: Ints, joined: Constraints) -> Bools:
    """Mask (m,) of the edges to keep, all of them while they are few: about ``WAYS + LOOPS + 1`` a submap at most.

    An edge that connects two components always stays. Of the odometry edges a spanning tree stays. Where these leave
    several components, the most certain loop between each two of them stays.

    Args:
        keys: of the submaps, rising.
        joined: edges between them.
    """
    n, m = len(keys), len(joined.loop)
    kept = np.ones(m, np.bool_)
    if m <= SLACK * (WAYS + LOOPS) * n:
        return kept
    edges, vague = np.ascontiguousarray(np.searchsorted(keys, joined.between)), vagueness(joined.information)
    kept[:] = surest(edges, vague, ~joined.loop, WAYS) | surest(edges, vague, joined.loop, LOOPS)
    parent, part = parts(n, edges, joined.loop)
    child = np.flatnonzero(parent != NONE)
    kept |= ~joined.loop & np.isin(pairs(edges, n), pairs(np.column_stack((child, parent[child])), n))
    between = np.flatnonzero(joined.loop & (part[edges[:, 0]] != part[edges[:, 1]]))
    kept[first_of_each(pairs(part[edges], n), vague, between)] = True
    return kept


def handed_on(keys: Ints, joined: Constraints, key: int) -> Ints:
    """Rows of the edges that a neighbour takes over from a removed submap, in their order.

    These are all odometry edges and the most certain loops. Where odometry edges leave several components, they include
    the most certain loop to each of the others.
    """
    n, rows = len(keys), joined.of(key)
    loops = rows[joined.loop[rows]]
    if len(loops) <= LOOPS:
        return rows
    edges, vague = np.ascontiguousarray(np.searchsorted(keys, joined.between)), vagueness(joined.information)
    _, part = parts(n, edges, joined.loop)
    kept = ~joined.loop[rows]
    kept |= np.isin(rows, loops[np.argsort(vague[loops], kind="stable")[:LOOPS]])
    between = loops[part[edges[loops, 0]] != part[edges[loops, 1]]]
    kept |= np.isin(rows, first_of_each(pairs(part[edges], n), vague, between))
    return np.asarray(rows[kept])


def parts(n: int, edges: Ints, doubtful: Bools) -> tuple[Ints, Ints]:
    """Parent of each submap in a tree of odometry edges, and the root of its component."""
    order, parent = spanning(n, edges, doubtful, np.ones(n, np.bool_))
    part = np.arange(n)
    for i in order[parent[order] != NONE].tolist():
        part[i] = part[parent[i]]
    return parent, part


def first_of_each(kind: Ints, vague: Array, rows: Ints) -> Ints:
    """The most certain one of these rows of each kind."""
    rows = rows[np.argsort(vague[rows], kind="stable")]
    return np.asarray(rows[np.unique(kind[rows], return_index=True)[1]])


def pairs(edges: Ints, n: int) -> Ints:
    """A number for each pair of ends, in either order."""
    return np.asarray(edges.min(axis=1) * n + edges.max(axis=1))


def vagueness(information: Array) -> Array:
    """Trace of the covariance, (m,), from the upper triangles (m, 6) of the information."""
    a, b, c, d, e, f = information.T  # (a b c; b d e; c e f)
    minors = (d * f - e * e) + (a * f - c * c) + (a * d - b * b)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return np.asarray(minors / determinant)


def surest(edges: Ints, vague: Array, asked: Bools, most: int) -> Bools:
    """Mask (m,) of the ``asked`` edges among the ``most`` most certain ones at either end; of equals the latest."""
    rows = np.flatnonzero(asked)[::-1]
    end, row = edges[rows].T.ravel(), np.concatenate((rows, rows))
    by_end = np.lexsort((vague[row], end))
    end = end[by_end]
    rank = np.arange(len(end)) - np.searchsorted(end, end)
    kept = np.zeros(len(asked), np.bool_)
    kept[row[by_end[rank < most]]] = True
    return kept
