"""Constraints of the submap graph: what is joined, taken out and kept."""

import numpy as np
import pytest

from estimator.job_queue import JobQueue
from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Submap
from estimator.mapping.pose_graph import UPPER, Graph, optimise
from estimator.mapping.submap_graph import SubmapGraph
from estimator.measurements import Array
from estimator.numerics import se2
from tests.estimator.circuit import SMALL

pytestmark = pytest.mark.jit


def random_graph(rng: np.random.Generator, n: int = 7) -> tuple[Constraints, Array]:
    truth = np.column_stack((rng.uniform(-3, 3, (n, 2)), rng.uniform(-3, 3, n)))
    made = Constraints()
    for a, b in [(k, k + 1) for k in range(n - 1)] + [(0, 4), (1, 6), (2, 5)]:
        P = np.diag(rng.uniform(0.5, 2.0, 3) * (0.01**2, 0.02**2, 0.01**2))
        noise = rng.normal(0.0, 1.0, 3) * np.sqrt(np.diag(P))
        made.add(a + 1, b + 1, se2.compose(se2.between(truth[a], truth[b]), noise), P, b != a + 1)
    return made, truth


def test_a_submap_taken_out_leaves_the_others_where_they_are() -> None:
    """Exactly so for a link of a chain: composing constraints loses nothing there."""
    rng = np.random.default_rng(1)
    made, truth = random_graph(rng)
    made.keep(~made.loop)
    made.add(1, 7, se2.between(truth[0], truth[6]), SMALL, True)

    def solved(keys: list[int]) -> Array:
        edges = np.searchsorted(keys, made.between)
        doubtful = np.zeros(len(edges), np.bool_)
        graph = Graph(truth[np.array(keys) - 1], edges, made.T, made.information, doubtful)
        return optimise(graph, settled=1e-12).poses

    whole = solved([1, 2, 3, 4, 5, 6, 7])
    for gone in (4, 5):
        row = int(made.of(gone)[0])
        hub, T, P = made.seen_from(gone, row)
        A = se2.adjoint(T)
        made.reroute(gone, hub, se2.inverse(T), A @ P @ A.T)
    assert not np.isin((4, 5), made.between).any()
    np.testing.assert_allclose(solved([1, 2, 3, 6, 7]), whole[[0, 1, 2, 5, 6]], atol=3e-4)


def test_the_inverse_of_a_constraint_says_the_same() -> None:
    made, _ = random_graph(np.random.default_rng(3))
    for row in range(len(made.loop)):
        a, b = made.between[row].tolist()
        back, forth = made.seen_from(b, row), made.seen_from(a, row)
        assert (back[0], forth[0]) == (a, b)
        np.testing.assert_allclose(se2.compose(forth[1], back[1]), np.zeros(3), atol=1e-12)
        d = np.array((1e-4, -2e-4, 3e-4))  # the same small error, seen from either end
        seen = se2.log(se2.compose(se2.inverse(back[1]), se2.inverse(se2.compose(forth[1], se2.exp(d)))))
        np.testing.assert_allclose(d @ np.linalg.solve(forth[2], d), seen @ np.linalg.solve(back[2], seen), rtol=1e-2)


def test_only_the_latest_loops_of_a_pair_stay() -> None:
    made = Constraints()
    made.add(1, 2, np.zeros(3), SMALL, False)
    for k in range(9):
        made.add(1, 2, np.array((0.1 * k, 0.0, 0.0)), SMALL, True)
    assert made.loop.sum() == 3
    np.testing.assert_allclose(made.T[:, 0], (0.0, 0.6, 0.7, 0.8))


def test_the_covariance_of_a_pose_is_its_block_of_the_inverse() -> None:
    made, truth = random_graph(np.random.default_rng(4))
    edges = made.between - 1
    graph = Graph(truth, edges, made.T, made.information, np.zeros(len(edges), np.bool_))
    solution = optimise(graph, settled=1e-12, covariance_of=6)
    H = np.zeros((21, 21))
    for (i, j), T, told in zip(edges, made.T, made.information, strict=True):
        W, J = np.zeros((3, 3)), np.zeros((3, 21))
        for k, (r, c) in enumerate(UPPER):
            W[r, c] = W[c, r] = told[k]
        for column in range(6):
            which, axis = (i, column) if column < 3 else (j, column - 3)
            moved = []
            for step in (1e-6, -1e-6):
                P = solution.poses.copy()
                P[which, axis] += step
                moved.append(se2.between(T, se2.between(P[i], P[j])))
            J[:, 3 * which + axis] = (moved[0] - moved[1]) / 2e-6
        H += J.T @ W @ J
    np.testing.assert_allclose(solution.covariance, np.linalg.inv(H[3:, 3:])[-3:, -3:], rtol=1e-5, atol=1e-12)
    assert not optimise(graph, covariance_of=0).covariance.any()  # held


@pytest.mark.parametrize("drift_m", [0.0, 2.0])
def test_a_submap_taken_out_before_its_loop_is_solved_moves_by_the_loop(drift_m: float) -> None:
    graph, P = SubmapGraph(JobQueue()), np.diag((0.01**2, 0.01**2, 0.005**2))
    at = np.array(((0.0, 0.0, 0.0), (5.0, 0.0, 1.0), (1.0 + drift_m, 0.0, 2.0)))
    graph.submaps = {key: Submap(key, key, T.copy(), T.copy()) for key, T in enumerate(at, 1)}
    for a, b in ((1, 2), (2, 3)):
        graph.constraints.add(a, b, se2.between(at[a - 1], at[b - 1]), 9.0 * P, False)
    loop, gone = np.array((1.0, 0.0, 2.0)), graph.submaps[1]
    graph.constraints.add(1, 3, loop, P, True)
    graph.drop(gone)
    np.testing.assert_allclose(se2.between(gone.place(), graph.submaps[3].place()), loop, atol=1e-9)
