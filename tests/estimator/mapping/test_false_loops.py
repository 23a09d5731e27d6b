"""False loops are voted out at the settings that the map is made with: real ones, random ones, a mirrored room."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from estimator.mapping.loop_closure import MOST, PHI, SETTLED
from estimator.mapping.pose_graph import Graph, Solution, optimise
from estimator.measurements import Array
from estimator.numerics import se2
from tools.bench.posegraph import dense, doubting, read_g2o, with_false_loops
from tools.sim.building.buildings import building
from tools.sim.robot.drive import Body, Drive

WAY, LOOP = np.array((0.02, 0.02, 0.006)), np.array((0.025, 0.025, 0.008))


def solved(graph: Graph) -> Solution:
    return optimise(graph, MOST, SETTLED, PHI)


def information(sigma: Array, count: int) -> Array:
    return np.tile((sigma[0] ** -2, 0.0, 0.0, sigma[1] ** -2, 0.0, sigma[2] ** -2), (count, 1))


def floor(laps: int = 2, seed: int = 0) -> tuple[Graph, Array]:
    """Submaps 3 m apart on the tour of the office floor, loops where it comes back; the start is dead reckoning."""
    rng = np.random.default_rng(seed)
    drive = Drive(building("office_floor").route, Body(), 0.0)
    truth = drive.pose(np.arange(0.0, laps * drive.lap_s, 5.0))
    n = len(truth)
    pairs = [(k, k + 1) for k in range(n - 1)]
    loops = [
        (i, j)
        for i, j in combinations(range(n), 2)
        if j - i > 5 and np.hypot(*(truth[i] - truth[j])[:2]) < 2.0 and rng.random() < 0.7
    ]
    sigma = np.concatenate((np.tile(WAY, (n - 1, 1)), np.tile(LOOP, (len(loops), 1))))
    pairs += loops
    between = np.array([se2.between(truth[i], truth[j]) for i, j in pairs])
    between += sigma * rng.standard_normal(between.shape)
    poses = [truth[0]]
    for T in between[: n - 1]:
        poses.append(se2.compose(poses[-1], T))
    told = np.concatenate((information(WAY, n - 1), information(LOOP, len(loops))))
    return Graph(np.array(poses), np.array(pairs, np.int64), between, told, np.arange(len(pairs)) >= n - 1), truth


def distance(a: Array, b: Array) -> float:
    return float(np.hypot(*(a - b)[:, :2].T).max())


@pytest.mark.jit
@pytest.mark.parametrize("seed", range(3))
def test_random_loops_in_a_building_are_voted_out(seed: int) -> None:
    """Three in ten loops are false; the map is what it is without them, and every one of them is disbelieved."""
    graph, _ = floor(seed=seed)
    clean = solved(graph)
    found = solved(with_false_loops(graph, 0.3, seed))
    true, false = found.trust[: len(graph.edges)], found.trust[len(graph.edges) :]
    assert len(false) > 25
    assert np.all(false < 0.1)
    assert np.mean(true[graph.doubtful] > 0.25) > 0.98
    assert distance(found.poses, clean.poses) < 0.05


@pytest.mark.jit
def test_a_mirrored_room_is_voted_out_and_the_good_map_kept() -> None:
    """Five loops in a row agree with each other that the robot stands at the other end of the floor, turned round."""
    graph, truth = floor()
    clean = solved(graph)
    n = len(truth)
    centre = np.append(0.5 * (truth[:, :2].min(axis=0) + truth[:, :2].max(axis=0)), 0.0)
    mirror = se2.compose(se2.compose(centre, np.array((0.0, 0.0, np.pi))), se2.inverse(centre))
    rows = []
    for k in range(n - 30, n - 25):
        said = se2.compose(mirror, clean.poses[k])
        near = int(np.argmin(np.hypot(*(clean.poses[: n // 2] - said)[:, :2].T)))
        rows.append((near, k, *se2.between(clean.poses[near], said)))
    told = np.array(rows)
    spoiled = Graph(
        clean.poses.copy(),
        np.vstack((graph.edges, told[:, :2].astype(np.int64))),
        np.vstack((graph.between, told[:, 2:])),
        np.vstack((graph.information, information(LOOP, 5))),
        np.append(graph.doubtful, np.ones(5, np.bool_)),
    )
    found = solved(spoiled)
    assert np.all(found.trust[-5:] < 0.01)
    assert distance(found.poses, clean.poses) < 0.01


@pytest.mark.jit
def test_a_true_loop_after_much_drift_is_believed_all_the_same() -> None:
    """Dead reckoning ends 3.6 m off; judged by noise alone the only loop would never get a say."""
    graph, truth = floor(laps=1, seed=5)
    ways, n = np.flatnonzero(~graph.doubtful), len(truth)
    once = Graph(
        graph.poses.copy(),
        np.vstack((graph.edges[ways], ((0, n - 1),))),
        np.vstack((graph.between[ways] + (0.0, 0.0, 0.0018), se2.between(truth[0], truth[-1]))),
        np.vstack((graph.information[ways], information(LOOP, 1))),
        np.arange(len(ways) + 1) == len(ways),
    )
    for k in range(1, n):
        once.poses[k] = se2.compose(once.poses[k - 1], once.between[k - 1])
    assert distance(once.poses[-1:], truth[-1:]) > 3.0
    found = solved(once)
    assert found.trust[-1] > 0.9
    assert distance(found.poses[-1:], truth[-1:]) < 0.1


@pytest.mark.jit
def test_bicocca_is_voted_out_at_the_settings_that_ship(log_root: Path) -> None:
    """The lowest cost known for this file (from any start scale, at any number of iterations) is reached."""
    graph = doubting(read_g2o(log_root / "posegraphs" / "bicocca_30pct_false_loops.g2o.gz"))
    found = solved(graph)
    trust = found.trust[graph.doubtful]
    assert found.converged
    assert found.chi2 < 1.001 * 1842.39
    assert 0.2 < np.mean(trust < 0.25) < 0.35
    other = optimise(graph, 3 * MOST, SETTLED, 2.0 * PHI)
    assert distance(found.poses, other.poses) < 1.5


@pytest.mark.slow
def test_a_dense_graph_is_solved() -> None:
    graph = dense()
    found = optimise(graph)
    freedom = 3 * (len(graph.edges) - len(graph.poses) + 1)
    assert found.converged
    assert 0.9 * freedom < found.chi2 < 1.1 * freedom
