"""Steps along a spanning tree: its constraints get the error that the linear equations have foretold."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.mapping.pose_graph_kernels import carry_on, spanning
from estimator.numerics import se2


def some_graph(n: int, m: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (any pairs), which are doubted, which poses are free."""
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, n, (m, 2)).astype(np.int64)
    return edges, rng.random(m) < 0.3, rng.random(n) > 0.15


@given(n=st.integers(1, 30), m=st.integers(0, 50), seed=st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_the_tree_spans_every_part_and_hangs_on_what_is_held(n: int, m: int, seed: int) -> None:
    edges, doubtful, free = some_graph(n, m, seed)
    order, parent = spanning(n, edges, doubtful, free)
    assert sorted(order) == list(range(n))
    place = np.argsort(order)
    sure = {frozenset(edge) for edge in edges[~doubtful].tolist()}
    near: list[set[int]] = [set() for _ in range(n)]
    for i, j in edges[~doubtful].tolist():
        near[i].add(j)
        near[j].add(i)
    for k in range(n):
        if parent[k] >= 0:
            assert place[parent[k]] < place[k]
            assert frozenset((k, int(parent[k]))) in sure
        elif free[k]:  # the first of a part that nothing holds
            part, front = {k}, [k]
            while front:
                front = [j for i in front for j in near[i] if j not in part and not part.add(j)]  # type: ignore[func-returns-value]  # adds as it goes
            assert all(free[j] for j in part)
            assert k == min(part)
    assert np.all(parent[~free] < 0)


def test_the_constraints_of_the_tree_are_met_exactly_however_far_they_turn() -> None:
    rng = np.random.default_rng(2)
    n = 12
    poses = np.cumsum(rng.normal(0.0, 1.0, (n, 3)), axis=0)
    edges = np.column_stack((np.arange(n - 1), np.arange(1, n))).astype(np.int64)
    free = np.arange(n) > 0
    place = np.where(free, np.arange(n) - 1, -1)
    step = rng.normal(0.0, 0.4, (n - 1, 3))
    tree = spanning(n, edges, np.zeros(n - 1, bool), free)
    out = np.empty((n, 3))
    carry_on(poses, step, place, tree, out)
    np.testing.assert_array_equal(out[0], poses[0])
    full = np.vstack((np.zeros(3), step))
    h = 1e-7
    for i, j in edges:
        was = se2.between(poses[i], poses[j])
        foretold = was + (se2.between(poses[i] + h * full[i], poses[j] + h * full[j]) - was) / h
        np.testing.assert_allclose(se2.between(out[i], out[j])[:2], foretold[:2], atol=1e-5)
        np.testing.assert_allclose(out[j, 2] - out[i, 2], foretold[2], atol=1e-5)


def test_a_piece_that_turns_as_a_whole_keeps_its_shape() -> None:
    """Alone, each pose goes along its own arc: what turns together about one point stays together."""
    rng = np.random.default_rng(3)
    poses, centre, turn = rng.normal(0.0, 5.0, (9, 3)), np.array((2.0, -1.0)), 0.8
    away = poses[:, :2] - centre
    step = np.column_stack((-turn * away[:, 1], turn * away[:, 0], np.full(9, turn)))
    alone = np.arange(9), np.full(9, -1)
    out = np.empty((9, 3))
    carry_on(poses, step, np.arange(9), alone, out)
    for k in range(8):
        was, now = se2.between(poses[k], poses[k + 1]), se2.between(out[k], out[k + 1])
        np.testing.assert_allclose(now[:2], was[:2], atol=1e-12)
    np.testing.assert_allclose(out[:, 2], poses[:, 2] + turn)
