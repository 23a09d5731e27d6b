"""Which constraints of the graph stay when a place has been driven through so often that it has more than it needs.

Every submap that is taken out leaves what it was joined with to a neighbour, so that lap after lap each submap would be
joined with every other. Of those that a submap has, the surest say next to all that is known; the others cost memory
and every solution of the graph its time.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.mapping.constraints import Constraints
from estimator.mapping.spanning_tree_step import spanning
from estimator.numerics.arrays import Array, Bools, Ints
from estimator.numerics.elimination_ordering import NONE

WAYS, LOOPS = 2, 4
"""Constraints of each kind that a submap keeps for itself; it may have more that the other end keeps."""

SLACK: Final = 1.25
"""They are thinned out when there are so many times more than that: not at every one."""


def thinned(keys: Ints, joined: Constraints) -> Bools:
    """Which constraints stay, (m,), all of them while they are few: at most ``WAYS + LOOPS + 1`` a submap, about.

    Never one without which a part of the graph would come loose: of the ways a tree stays, and where ways alone leave
    several parts, the surest loop between each two of these.

    Args:
        keys: of the submaps, rising.
        joined: constraints between them.
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
    """Of a submap that is taken out, the constraints that its neighbour gets: rows, in their order.

    All ways, the surest loops, and where ways alone leave several parts the surest loop to each of the others.
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
    """Of each submap its parent in a tree of ways, and the root of the part it belongs to."""
    order, parent = spanning(n, edges, doubtful, np.ones(n, np.bool_))
    part = np.arange(n)
    for i in order[parent[order] != NONE].tolist():
        part[i] = part[parent[i]]
    return parent, part


def first_of_each(kind: Ints, vague: Array, rows: Ints) -> Ints:
    """Of these rows the surest one of each kind."""
    rows = rows[np.argsort(vague[rows], kind="stable")]
    return np.asarray(rows[np.unique(kind[rows], return_index=True)[1]])


def pairs(edges: Ints, n: int) -> Ints:
    """A number for each two ends, whichever comes first."""
    return np.asarray(edges.min(axis=1) * n + edges.max(axis=1))


def vagueness(information: Array) -> Array:
    """Trace of the covariance, (m,), from the upper triangles (m, 6) of the information."""
    a, b, c, d, e, f = information.T  # (a b c; b d e; c e f)
    minors = (d * f - e * e) + (a * f - c * c) + (a * d - b * b)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return np.asarray(minors / determinant)


def surest(edges: Ints, vague: Array, asked: Bools, most: int) -> Bools:
    """Those among the ``asked`` that are one of the ``most`` surest at either end; of equals the latest, (m,)."""
    rows = np.flatnonzero(asked)[::-1]
    end, row = edges[rows].T.ravel(), np.concatenate((rows, rows))
    by_end = np.lexsort((vague[row], end))
    end = end[by_end]
    rank = np.arange(len(end)) - np.searchsorted(end, end)
    kept = np.zeros(len(asked), np.bool_)
    kept[row[by_end[rank < most]]] = True
    return kept
