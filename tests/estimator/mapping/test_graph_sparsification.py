"""How many constraints stay, and that the graph holds together whatever is taken out."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from estimator.mapping.constraints import Constraints
from estimator.mapping.graph_sparsification import LOOPS, SLACK, WAYS, handed_on, surest, thinned, vagueness
from estimator.numerics import se2


def graph(n: int, m: int, share: float, seed: int) -> Constraints:
    """Ways and loops between ``n`` submaps at random, of any certainty; pairs may repeat."""
    rng = np.random.default_rng(seed)
    a = rng.integers(0, n, m)
    b = (a + rng.integers(1, n, m)) % n
    root = rng.normal(0.0, 1.0, (m, 3, 3)) + 2.0 * np.eye(3)
    H = (root @ root.transpose(0, 2, 1)) * 10.0 ** rng.uniform(1.0, 5.0, (m, 1, 1))
    upper = H[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return Constraints(10 + 3 * np.column_stack((a, b)), rng.normal(0.0, 1.0, (m, 3)), upper, rng.random(m) < share)


def parts(n: int, edges: np.ndarray) -> tuple[int, list[int]]:
    whole = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, label = connected_components(whole, directed=False)
    return int(count), label.tolist()


@given(st.integers(2, 40), st.integers(0, 1500), st.floats(0.0, 1.0), st.integers(0, 10_000))
@settings(max_examples=150, deadline=None)
def test_few_stay_and_nothing_comes_loose(n: int, m: int, share: float, seed: int) -> None:
    made, keys = graph(n, m, share, seed), 10 + 3 * np.arange(n)
    kept = thinned(keys, made)
    if m <= SLACK * (WAYS + LOOPS) * n:
        assert kept.all()
        return
    edges = (made.between - 10) // 3
    of_ways = parts(n, edges[~made.loop])
    assert parts(n, edges[kept & ~made.loop]) == of_ways
    assert parts(n, edges[kept]) == parts(n, edges)
    least = sum(len({*pair}) == 2 for pair in np.sort(np.array(of_ways[1])[edges], axis=1).tolist()) and of_ways[0]
    doubled = 2 * n  # a pair that a tree runs along stays as often as it is there: `Constraints.add` has one
    assert (kept & ~made.loop).sum() <= (WAYS + 1) * n + doubled + np.bincount(pair_of(edges[~made.loop], n)).max() * n
    assert (kept & made.loop).sum() <= LOOPS * n + least * (least - 1) // 2


def pair_of(edges: np.ndarray, n: int) -> np.ndarray:
    return np.append(edges.min(axis=1) * n + edges.max(axis=1), 0)


def test_vagueness_is_the_trace_of_the_covariance() -> None:
    made = graph(9, 60, 0.5, 1)
    traces = [np.trace(made.covariance(row)) for row in range(60)]
    np.testing.assert_allclose(vagueness(made.information), traces, rtol=1e-4)


def test_the_surest_of_either_end_stay_and_of_equals_the_latest() -> None:
    edges = np.array(((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (0, 1)))
    vague = np.array((5.0, 1.0, 2.0, 3.0, 9.0, 5.0))
    asked = np.array((True, True, True, True, False, True))
    # 0 keeps (0, 2); 1 the latest of its two equals; 3 and 4 have one each
    assert surest(edges, vague, asked, 1).tolist() == [False, True, True, True, False, True]


@given(st.integers(3, 30), st.integers(2, 600), st.floats(0.0, 1.0), st.integers(0, 10_000))
@settings(max_examples=100, deadline=None)
def test_a_submap_taken_out_hands_on_little_and_tears_nothing(n: int, m: int, share: float, seed: int) -> None:
    made, keys = graph(n, m, share, seed), 10 + 3 * np.arange(n)
    ends = np.searchsorted(keys, made.between)
    gone = int(ends[0, 0])
    before = parts(n, ends)[1]
    rows = handed_on(keys, made, int(keys[gone]))
    loops = int(made.loop[rows].sum())
    foreign = len(set(parts(n, ends[~made.loop])[1])) - 1
    assert loops <= LOOPS + foreign
    assert set(rows) >= set(np.flatnonzero(~made.loop & (ends == gone).any(axis=1)))
    if not len(rows):
        return
    hub, T, P = made.seen_from(int(keys[gone]), int(rows[0]))
    made.reroute(int(keys[gone]), hub, se2.inverse(T), P, rows)
    assert not (made.between == keys[gone]).any()
    after = parts(n, np.searchsorted(keys, made.between))[1]
    rest = [k for k in range(n) if k != gone]
    same = {(before[a] == before[b]) == (after[a] == after[b]) for a in rest for b in rest}
    assert same == {True}
