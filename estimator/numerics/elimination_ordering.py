"""Minimum-degree elimination ordering and symbolic factorisation of a pose graph.

Approximate minimum degree on the quotient graph (Amestoy, Davis, Duff: An Approximate Minimum Degree Ordering
Algorithm, SIAM J. Matrix Anal. Appl. 17(4), 1996). The nodes are poses, not scalars. The three unknowns of a pose
always belong together, which makes the graph nine times smaller and its order better. The element that an elimination
leaves is the pattern of its column in the factor. Ordering and symbolic factorisation are therefore one pass.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Ints
from estimator.numerics.jit import kernel

NONE = -1


@kernel("Tuple((i8[::1], i8[::1]))(i8, i8[:, ::1])", aside=True)
def adjacency(n: int, edges: Ints) -> tuple[Ints, Ints]:
    """Adjacency lists of ``n`` poses from edges (m, 2), symmetric and without duplicates.

    Self edges and negative indices are ignored. Returns the start of each list (n + 1,) and the neighbours.
    """
    start = np.zeros(n + 1, np.int64)
    for k in range(len(edges)):
        i, j = edges[k, 0], edges[k, 1]
        if i != j and i >= 0 and j >= 0:
            start[i + 1] += 1
            start[j + 1] += 1
    for i in range(n):
        start[i + 1] += start[i]
    fill = start[:n].copy()
    near = np.empty(start[n], np.int64)
    for k in range(len(edges)):
        i, j = edges[k, 0], edges[k, 1]
        if i != j and i >= 0 and j >= 0:
            near[fill[i]] = j
            near[fill[j]] = i
            fill[i] += 1
            fill[j] += 1
    seen = np.full(n, NONE)
    out = 0
    first = np.zeros(n + 1, np.int64)
    for i in range(n):
        for at in range(start[i], start[i + 1]):
            j = near[at]
            if seen[j] != i:
                seen[j] = i
                near[out] = j
                out += 1
        first[i + 1] = out
    return first, near[:out].copy()


@kernel("void(i8, i8, i8[:, ::1], i8[::1])", inner=True)
def bucket_in(i: int, degree: int, links: Ints, head: Ints) -> None:
    """Insert pose ``i`` at the head of the list of its degree; ``links``: (next, previous) of each pose."""
    links[i, 0] = head[degree]
    links[i, 1] = NONE
    if head[degree] != NONE:
        links[head[degree], 1] = i
    head[degree] = i


@kernel("void(i8, i8, i8[:, ::1], i8[::1])", inner=True)
def bucket_out(i: int, degree: int, links: Ints, head: Ints) -> None:
    """Remove pose ``i`` from the list of its degree."""
    after, before = links[i, 0], links[i, 1]
    if before == NONE:
        head[degree] = after
    else:
        links[before, 0] = after
    if after != NONE:
        links[after, 1] = before


Quotient = tuple[Ints, Ints, Ints, Ints]
"""Quotient graph: slot start of each pose, adjacency list, number of elements at the start of a slot, slot length."""

Passed = tuple[Ints, Ints, Ints]
"""Eliminated poses: step of each pose (NONE: not yet), whether its element was absorbed, bounds of the elements."""

QUOTIENT = "Tuple((i8[::1], i8[::1], i8[::1], i8[::1]))"
PASSED = "Tuple((i8[::1], i8[::1], i8[::1]))"


@kernel(f"i8(i8, {QUOTIENT}, {PASSED})", inner=True)
def reach_of(p: int, graph: Quotient, passed: Passed) -> int:
    """Upper limit of the number of entries that eliminating ``p`` fills in."""
    first, near, elements, length = graph
    place, _, start = passed
    reach = length[p] - elements[p]
    for at in range(first[p], first[p] + elements[p]):
        reach += start[place[near[at]] + 1] - start[place[near[at]]]
    return int(reach)


@kernel(f"i8(i8, i8, {QUOTIENT}, {PASSED}, i8[::1], i8[::1])", inner=True)
def gather(k: int, p: int, graph: Quotient, passed: Passed, mark: Ints, fill: Ints) -> int:
    """Write the new element of pivot ``p``: its neighbours and the elements it absorbs. Returns its end in ``fill``."""
    first, near, elements, length = graph
    place, gone, start = passed
    mark[p] = k
    end = start[k]
    for at in range(first[p] + elements[p], first[p] + length[p]):
        j = near[at]
        if place[j] == NONE and mark[j] != k:
            mark[j] = k
            fill[end] = j
            end += 1
    for at in range(first[p], first[p] + elements[p]):
        e = near[at]
        if gone[e]:
            continue
        gone[e] = 1
        for m in range(start[place[e]], start[place[e] + 1]):
            j = fill[m]
            if mark[j] != k and place[j] == NONE:
                mark[j] = k
                fill[end] = j
                end += 1
    return int(end)


@kernel(f"void(i8, {QUOTIENT}, {PASSED}, i8[::1], i8[::1], i8)", inner=True)
def weigh(k: int, graph: Quotient, passed: Passed, fill: Ints, weight: Ints, tag: int) -> None:
    """Size of the part of each adjacent element outside the new element, stored as ``weight - tag``."""
    first, near, elements, _ = graph
    place, gone, start = passed
    for m in range(start[k], start[k + 1]):
        i = fill[m]
        for at in range(first[i], first[i] + elements[i]):
            e = near[at]
            if not gone[e]:
                if weight[e] < tag:
                    weight[e] = tag + start[place[e] + 1] - start[place[e]]
                weight[e] -= 1


@kernel(f"i8(i8, i8, i8, {QUOTIENT}, {PASSED}, Tuple((i8[::1], i8[::1], i8)))", inner=True)
def renew(k: int, p: int, i: int, graph: Quotient, passed: Passed, marks: tuple[Ints, Ints, int]) -> int:
    """Update the slot of ``i`` after the elimination of ``p``: remove what the new element covers.

    Returns a bound of the degree of ``i`` without the new element.
    """
    first, near, elements, length = graph
    place, gone, _ = passed
    mark, weight, tag = marks
    out, bound = first[i], 0
    rest, last = first[i] + elements[i], first[i] + length[i]
    for at in range(first[i], rest):
        e = near[at]
        if gone[e]:
            continue
        if weight[e] == tag:
            gone[e] = 1  # it lies completely in the new element
            continue
        near[out] = e
        out += 1
        bound += weight[e] - tag
    if out == rest and rest < last:
        # No absorbed element freed an entry. A neighbour that the new element covers frees it. There is one, because
        # otherwise i would not be in it.
        for at in range(rest, last):
            if near[at] == p or mark[near[at]] == k:
                near[at] = near[rest]
                break
        rest += 1
    near[out] = p
    out += 1
    elements[i] = out - first[i]
    for at in range(rest, last):
        j = near[at]
        if mark[j] != k and place[j] == NONE:
            near[out] = j
            out += 1
            bound += 1
    length[i] = out - first[i]
    return bound


@kernel("Tuple((i8[::1], i8[::1], i8[::1]))(i8[::1], i8[::1])", aside=True)
def minimum_degree(first: Ints, near: Ints) -> tuple[Ints, Ints, Ints]:
    """Elimination order (n,), and the fill of each eliminated pose: start (n + 1,) and poses by old number.

    ``near`` is overwritten. A pose's slot holds its elements first, then the neighbours not yet eliminated. Both
    together never exceed the slot.
    """
    n = len(first) - 1
    order, start = np.empty(n, np.int64), np.zeros(n + 1, np.int64)
    fill = np.empty(max(16, 4 * len(near)), np.int64)
    degree = first[1:] - first[:-1]
    graph = (first, near, np.zeros(n, np.int64), degree.copy())
    passed = (np.full(n, NONE), np.zeros(n, np.int64), start)
    head, links = np.full(n + 1, NONE), np.full((n, 2), NONE)
    for i in range(n - 1, -1, -1):
        bucket_in(i, degree[i], links, head)
    mark, weight, tag, least = np.full(n, NONE), np.zeros(n, np.int64), 1, 0
    for k in range(n):
        while head[least] == NONE:
            least += 1
        p = head[least]
        bucket_out(p, degree[p], links, head)
        reach = start[k] + reach_of(p, graph, passed)
        if reach > len(fill):
            larger = np.empty(2 * reach, np.int64)
            larger[: start[k]] = fill[: start[k]]
            fill = larger
        start[k + 1] = gather(k, p, graph, passed, mark, fill)
        order[k], passed[0][p] = p, k
        size = start[k + 1] - start[k]
        weigh(k, graph, passed, fill, weight, tag)
        for m in range(start[k], start[k + 1]):
            i = fill[m]
            bound = renew(k, p, i, graph, passed, (mark, weight, tag))
            bucket_out(i, degree[i], links, head)
            degree[i] = max(0, min(bound + size - 1, degree[i] + size - 1, n - k - 2))
            bucket_in(i, degree[i], links, head)
            least = min(least, degree[i])
        tag += n + 1
    return order, start, fill[: start[n]].copy()


@kernel("Tuple((i8[::1], i8[::1], i8[::1], i8[::1]))(i8[::1], i8[::1], i8[::1])", aside=True)
def columns(order: Ints, start: Ints, fill: Ints) -> tuple[Ints, Ints, Ints, Ints]:
    """Pattern of the factor in the new order, sorted: column start and rows; row start and columns."""
    n, total = len(order), len(fill)
    place = np.empty(n, np.int64)
    for k in range(n):
        place[order[k]] = k
    row_start = np.zeros(n + 1, np.int64)
    for m in range(total):
        row_start[place[fill[m]] + 1] += 1
    for k in range(n):
        row_start[k + 1] += row_start[k]
    at, across = row_start[:n].copy(), np.empty(total, np.int64)
    for k in range(n):
        for m in range(start[k], start[k + 1]):
            i = place[fill[m]]
            across[at[i]] = k
            at[i] += 1
    at, down = start[:n].copy(), np.empty(total, np.int64)
    for i in range(n):
        for m in range(row_start[i], row_start[i + 1]):
            k = across[m]
            down[at[k]] = i
            at[k] += 1
    return start, down, row_start, across
