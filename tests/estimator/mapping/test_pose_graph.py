"""The pose graph: its minimum, its steps along the spanning tree, and its limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.mapping.pose_graph import Graph, optimise
from estimator.mapping.pose_graph_kernels import carry_on, cost, spanning
from estimator.measurements import Array
from estimator.numerics import se2
from estimator.numerics.block_ldl import factor, solve
from estimator.numerics.elimination_ordering import adjacency, columns, minimum_degree

UPPER = np.triu_indices(3)
FIRM = np.array((400.0, 0.0, 0.0, 400.0, 0.0, 2500.0))


def random_edges(n: int, m: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    chain = np.column_stack((np.arange(n - 1), np.arange(1, n)))
    return np.concatenate((chain, rng.integers(0, n, (m, 2)))).astype(np.int64)


def pattern_slow(n: int, edges: np.ndarray, order: np.ndarray) -> list[set[int]]:
    """Eliminate on sets, in new numbers."""
    place = np.empty(n, int)
    place[order] = np.arange(n)
    near: list[set[int]] = [set() for _ in range(n)]
    for i, j in edges:
        if i != j:
            near[place[i]].add(int(place[j]))
            near[place[j]].add(int(place[i]))
    for k in range(n):
        later = {i for i in near[k] if i > k}
        for i in later:
            near[i] |= later - {i}
        near[k] = later
    return near


@given(n=st.integers(1, 40), m=st.integers(0, 60), seed=st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_the_pattern_is_what_elimination_fills_in(n: int, m: int, seed: int) -> None:
    edges = random_edges(n, m, seed)
    order, start, fill = minimum_degree(*adjacency(n, edges))
    assert sorted(order) == list(range(n))
    first, down, row_first, across = columns(order, start, fill)
    slow = pattern_slow(n, edges, order)
    for k in range(n):
        rows = down[first[k] : first[k + 1]].tolist()
        assert rows == sorted(slow[k])
        assert across[row_first[k] : row_first[k + 1]].tolist() == [c for c in range(n) if k in slow[c]]


def test_the_order_keeps_a_grid_sparse() -> None:
    """A 30 x 30 grid in its natural order fills 30 a column; a good order stays far below."""
    side = 30
    number = np.arange(side * side).reshape(side, side)
    edges = np.concatenate(
        [
            np.column_stack((number[:, :-1].ravel(), number[:, 1:].ravel())),
            np.column_stack((number[:-1].ravel(), number[1:].ravel())),
        ]
    )
    _, start, _ = minimum_degree(*adjacency(side * side, edges))
    assert start[-1] < 12 * side * side


@given(n=st.integers(2, 25), m=st.integers(0, 30), seed=st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_a_solution_solves_the_system(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges = random_edges(n, m, seed)
    order, start, fill = minimum_degree(*adjacency(n, edges))
    pattern = columns(order, start, fill)
    place = np.empty(n, int)
    place[order] = np.arange(n)
    dense = np.zeros((3 * n, 3 * n))
    for i, j in edges:
        if i != j:
            J = np.zeros((3, 3 * n))
            J[:, 3 * place[i] : 3 * place[i] + 3] = rng.normal(size=(3, 3))
            J[:, 3 * place[j] : 3 * place[j] + 3] = rng.normal(size=(3, 3))
            dense += J.T @ J
    dense += 0.1 * np.eye(3 * n)
    diagonal = np.array([dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(n)])
    below = np.array(
        [
            dense[3 * i : 3 * i + 3, 3 * k : 3 * k + 3]
            for k in range(n)
            for i in pattern[1][pattern[0][k] : pattern[0][k + 1]]
        ]
    ).reshape(-1, 3, 3)
    right = rng.normal(size=(n, 3))
    inverse, b = np.empty((n, 3, 3)), right.copy()
    assert factor(pattern, (diagonal.copy(), below), inverse) == -1
    solve(pattern, below, inverse, b)
    np.testing.assert_allclose(dense @ b.ravel(), right.ravel(), atol=1e-8)


def test_a_matrix_that_is_not_positive_definite_is_noticed() -> None:
    pattern = columns(*minimum_degree(*adjacency(2, np.array(((0, 1),)))))
    diagonal = np.stack((np.eye(3), -np.eye(3)))
    assert factor(pattern, (diagonal, np.zeros((1, 3, 3))), np.empty((2, 3, 3))) == 1


def walk(n: int, seed: int, loops: int) -> tuple[Array, Graph]:
    """A walk on a small floor with true loops; the start is its own odometry."""
    rng = np.random.default_rng(seed)
    truth = [np.zeros(3)]
    for _ in range(n - 1):
        turn = rng.choice((0.0, 0.0, np.pi / 2, -np.pi / 2))
        truth.append(se2.compose(truth[-1], np.array((1.0, 0.0, turn))))
    pairs = [(k, k + 1) for k in range(n - 1)]
    for _ in range(loops):
        i, j = sorted(rng.choice(n, 2, replace=False))
        pairs.append((int(i), int(j)))
    sigma = 1.0 / np.sqrt(FIRM[[0, 3, 5]])
    between = np.array([se2.between(truth[i], truth[j]) + rng.normal(0.0, sigma) for i, j in pairs])
    poses = [truth[0]]
    for k in range(n - 1):
        poses.append(se2.compose(poses[-1], between[k]))
    doubtful = np.arange(len(pairs)) >= n - 1
    return np.array(truth), Graph(
        np.array(poses), np.array(pairs, np.int64), between, np.tile(FIRM, (len(pairs), 1)), doubtful
    )


def chi2_slow(graph: Graph, poses: Array) -> float:
    total = 0.0
    for (i, j), z, w in zip(graph.edges, graph.between, graph.information, strict=True):
        e = se2.between(z, se2.between(poses[i], poses[j]))
        H = np.zeros((3, 3))
        H[UPPER] = w
        H = H + np.triu(H, 1).T
        total += float(e @ H @ e)
    return total


def test_the_optimum_is_one() -> None:
    """chi2 is what it says, noise alone is left, and no small step away from it is better."""
    _, graph = walk(60, 3, 40)
    graph.doubtful[:] = False
    found = optimise(graph, settled=1e-10)
    assert found.converged
    np.testing.assert_allclose(found.chi2, chi2_slow(graph, found.poses), rtol=1e-9)
    freedom = 3 * (len(graph.edges) - 59)
    assert 0.5 * freedom < found.chi2 < 1.6 * freedom
    rng = np.random.default_rng(0)
    for _ in range(50):
        step = rng.normal(0.0, 1e-4, found.poses.shape)
        step[0] = 0.0
        assert chi2_slow(graph, found.poses + step) > found.chi2


@pytest.mark.jit
def test_false_loops_are_voted_out() -> None:
    """30 % of the loops lead anywhere; the map is what it is without them."""
    truth, graph = walk(150, 7, 120)
    rng = np.random.default_rng(1)
    loops = np.flatnonzero(graph.doubtful)
    false = rng.choice(loops, int(0.3 * len(loops)), replace=False)
    true = np.setdiff1d(np.arange(len(graph.edges)), false)
    clean = optimise(
        Graph(graph.poses, graph.edges[true], graph.between[true], graph.information[true], graph.doubtful[true])
    )
    graph.between[false] = rng.uniform((-10, -10, -3), (10, 10, 3), (len(false), 3))
    found = optimise(graph)
    assert np.all(found.trust[false] < 0.1)
    assert np.mean(found.trust[np.setdiff1d(loops, false)] > 0.25) > 0.97
    apart = np.hypot(*(found.poses - clean.poses)[:, :2].T)
    assert apart.max() < 0.02
    assert np.hypot(*(found.poses - truth)[:, :2].T).max() < 0.6


def test_poses_known_absolutely_place_the_graph_and_a_wrong_one_does_not() -> None:
    truth, graph = walk(80, 5, 60)
    shift = np.array((3.0, -2.0, 0.7))
    where = np.arange(0, 80, 8)
    graph.anchored = where.astype(np.int64)
    graph.at = np.array([se2.compose(shift, truth[k]) for k in where])
    graph.at[3] += (4.0, 0.0, 0.0)
    graph.certainty = np.tile(FIRM, (len(where), 1))
    found = optimise(graph)
    expected = np.array([se2.compose(shift, T) for T in truth])
    assert np.hypot(*(found.poses - expected)[:, :2].T).max() < 0.3


def test_parts_that_nothing_joins_stay_where_they_are() -> None:
    _, graph = walk(30, 2, 20)
    apart = np.concatenate((graph.edges, graph.edges + 30))
    twice = Graph(
        np.concatenate((graph.poses, graph.poses + np.array((5.0, 5.0, 0.0)))),
        apart,
        np.concatenate((graph.between, graph.between)),
        np.concatenate((graph.information, graph.information)),
        np.zeros(len(apart), bool),
    )
    found = optimise(twice)
    assert found.parts == 2
    np.testing.assert_array_equal(found.poses[[0, 30]], twice.poses[[0, 30]])
    for k in range(30):
        one, two = se2.between(found.poses[0], found.poses[k]), se2.between(found.poses[30], found.poses[30 + k])
        np.testing.assert_allclose(se2.between(one, two), 0.0, atol=1e-3)


def test_poses_that_are_held_never_move_and_hold_the_others() -> None:
    """A stored map stays to the last bit; what was laid today comes to it by its loops, wherever it began."""
    truth, graph = walk(60, 3, 60)
    shift = np.array((2.0, 1.0, 0.4))
    graph.poses[:30] = [se2.compose(shift, T) for T in truth[:30]]
    graph.held = np.arange(60) < 30
    begun = graph.poses.copy()
    found = optimise(graph)
    np.testing.assert_array_equal(found.poses[:30], begun[:30])
    expected = np.array([se2.compose(shift, T) for T in truth[30:]])
    assert np.hypot(*(found.poses[30:] - expected)[:, :2].T).max() < 0.3
    assert not optimise(graph, covariance_of=3).covariance.any()
    assert np.all(np.diag(optimise(graph, covariance_of=40).covariance) > 0.0)


def test_a_held_pose_holds_its_own_part_only() -> None:
    _, graph = walk(30, 2, 20)
    twice = Graph(*(np.concatenate(two) for two in (
        (graph.poses, graph.poses), (graph.edges, graph.edges + 30), (graph.between, graph.between),
        (graph.information, graph.information), (graph.doubtful, graph.doubtful))))  # fmt: skip
    twice.held = np.arange(60) == 7
    found = optimise(twice)
    np.testing.assert_array_equal(found.poses[[7, 30]], twice.poses[[7, 30]])
    assert np.abs(found.poses[0] - twice.poses[0]).max() > 1e-6


def test_a_graph_that_is_held_altogether_stays() -> None:
    _, graph = walk(10, 0, 3)
    graph.held = np.ones(10, bool)
    np.testing.assert_array_equal(optimise(graph).poses, graph.poses)


def test_the_cost_is_the_sum_of_potentials() -> None:
    _, graph = walk(20, 1, 10)
    given_ = (graph.edges, graph.between, graph.information, np.zeros(len(graph.edges), bool))
    trust = np.empty(len(graph.edges))
    total = cost(graph.poses, given_, (graph.anchored, graph.at, graph.certainty), trust, 10.0)
    np.testing.assert_allclose(total, chi2_slow(graph, graph.poses), rtol=1e-12)
    assert np.all(trust == 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: g.edges.__setitem__((0, 1), 99), "edges: a constraint names pose"),
        (lambda g: g.poses.__setitem__((3, 0), np.nan), "poses: not finite in row 3"),
        (lambda g: g.information.__setitem__((2, 0), np.inf), "information: not finite in row 2"),
        (lambda g: setattr(g, "held", np.ones(3, bool)), "held: 3 rows for 10 poses"),
    ],
)
def test_what_is_no_graph_is_refused(change, message: str) -> None:  # type: ignore[no-untyped-def]
    _, graph = walk(10, 0, 3)
    change(graph)
    with pytest.raises(ValueError, match=message):
        optimise(graph)


def test_a_graph_of_one_pose() -> None:
    empty = np.empty((0, 2), np.int64)
    found = optimise(Graph(np.ones((1, 3)), empty, np.empty((0, 3)), np.empty((0, 6)), np.empty(0, bool)))
    np.testing.assert_array_equal(found.poses, np.ones((1, 3)))


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
