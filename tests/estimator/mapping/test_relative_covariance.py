"""How surely two places are known relative to each other: by the way, and by the surest path through the graph."""

from itertools import pairwise

import numpy as np
import pytest

from estimator.mapping.keyframe import ANYWHERE, Keyframe, Submap
from estimator.mapping.pose_graph import UPPER, Graph
from estimator.mapping.relative_covariance import UNTIED, tied
from estimator.mapping.submap_graph import SubmapGraph
from estimator.measurements import Array
from estimator.numerics import se2


def graph_of(poses: Array, edges: list[tuple[int, int]], P: Array, doubtful: list[bool] | None = None) -> Graph:
    """Constraints of equal covariance, in the axes of their second pose, that agree with the poses."""
    H = np.linalg.inv(P)
    return Graph(
        poses,
        np.array(edges),
        np.array([se2.between(poses[i], poses[j]) for i, j in edges]),
        np.array([[H[i, j] for i, j in UPPER]] * len(edges)),
        np.array(doubtful or [False] * len(edges)),
    )


def sampled(poses: Array, path: list[int], P: Array, rng: np.random.Generator) -> Array:
    """Errors (n, 3), map axes, of the path's end seen from its start, each step being off by a draw from ``P``."""
    L = np.linalg.cholesky(P)
    out = np.empty((4000, 3))
    for k in range(len(out)):
        T = poses[path[0]]
        for i, j in pairwise(path):
            T = se2.compose(se2.compose(T, se2.between(poses[i], poses[j])), se2.exp(L @ rng.standard_normal(3)))
        out[k] = T - poses[path[-1]]
    return out


def test_the_covariance_of_a_path_is_that_of_sampled_drives() -> None:
    rng = np.random.default_rng(3)
    poses = np.array([(0, 0, 0.3), (3, 1, 1.2), (4, 4, 2.5), (1, 6, -2.0)], dtype=float)
    P = np.array(((4e-4, 1e-4, 0.0), (1e-4, 1e-4, 2e-5), (0.0, 2e-5, 9e-5)))
    found = tied(graph_of(poses, [(0, 1), (1, 2), (2, 3)], P), poses, np.ones(3), 3)
    assert np.allclose(found[0], np.cov(sampled(poses, [0, 1, 2, 3], P, rng).T), rtol=0.15, atol=1e-4)
    assert not found[3].any()
    # from the other side: what ends at 0 and starts at 3 is joined by the same constraints
    back = tied(graph_of(poses, [(0, 1), (1, 2), (2, 3)], P), poses, np.ones(3), 0)
    A = np.array(((1, 0, -(poses[0] - poses[3])[1]), (0, 1, (poses[0] - poses[3])[0]), (0, 0, 1)))
    assert np.allclose(back[3], A @ found[0] @ A.T)


def test_the_surest_path_counts_and_a_disbelieved_loop_does_not() -> None:
    n = 30
    turn = 2 * np.pi * np.arange(n) / n
    poses = np.column_stack([10 * np.sin(turn), 10 - 10 * np.cos(turn), turn])
    edges = [(k, k + 1) for k in range(n - 1)] + [(0, n - 1)]
    P = np.diag((1e-4, 1e-4, 1e-6))
    graph = graph_of(poses, edges, P, [False] * (n - 1) + [True])
    by_loop = tied(graph, poses, np.ones(n), n - 1)
    by_way = tied(graph, poses, np.append(np.ones(n - 1), 0.1), n - 1)
    assert np.trace(by_loop[0]) == pytest.approx(np.trace(P))
    assert np.trace(by_way[0]) > 20 * np.trace(P)
    assert np.trace(by_loop[1]) == pytest.approx(2 * np.trace(P), rel=0.1)
    assert np.all(np.trace(by_loop, axis1=1, axis2=2) <= np.trace(by_way, axis1=1, axis2=2) + 1e-12)


def test_what_nothing_joins_is_not_known() -> None:
    poses = np.zeros((4, 3))
    found = tied(graph_of(poses, [(0, 1), (2, 3)], np.eye(3)), poses, np.ones(2), 3)
    assert np.allclose(found[0], UNTIED * np.eye(3))
    assert np.allclose(found[2], np.eye(3))
    none = Graph(poses, np.empty((0, 2), np.int64), np.empty((0, 3)), np.empty((0, 6)), np.empty(0, np.bool_))
    assert np.allclose(tied(none, poses, np.empty(0), 1)[3], UNTIED * np.eye(3))


def frame(key: int, T: Array) -> Keyframe:
    scan = np.full(3, 2.0, np.float32), np.ones(3, np.uint8)
    return Keyframe(key, Submap(0, key, T, T), T, np.zeros(3), np.linspace(-1, 1, 3), 0.0, *scan)


def test_the_way_since_a_submap_strays_as_the_place_in_it_does() -> None:
    atlas, rng = SubmapGraph(), np.random.default_rng(5)
    T = np.array((40.0, -20.0, 0.4))
    P = np.diag((1e-4, 2e-4, 1e-5))
    for key in range(1, 60):
        atlas.add(frame(key, T), P, 0.01, anew=False)
        newest = atlas.newest
        assert newest is not None
        assert np.allclose(atlas.strayed_since(newest, T), atlas.C, atol=1e-9)
        T = se2.compose(T, np.array((0.25, 0.0, rng.normal(0.0, 0.2))))
    first, here = atlas.submaps[1], atlas.T_odom_last
    assert np.allclose(atlas.strayed_since(first, here), atlas.spread(here), rtol=1e-6, atol=1e-9)
    assert np.allclose(atlas.apart(first, here), atlas.spread(here), rtol=1e-6, atol=1e-9)


def test_no_way_leads_across_a_break_nor_into_a_stored_map() -> None:
    atlas, T = SubmapGraph(), np.array((5.0, 2.0, 0.4))
    atlas.add(frame(1, T), 1e-4 * np.eye(3), 0.01, anew=False)
    atlas.add(frame(2, T), 1e-4 * np.eye(3), 0.01, anew=True)
    assert np.trace(atlas.apart(atlas.submaps[1], T)) < 1e-3, "wheels have carried the pose over a lost local map"
    atlas.detach(3)
    atlas.add(frame(3, T), 1e-4 * np.eye(3), 0.01, anew=True)
    assert np.trace(atlas.apart(atlas.submaps[1], T)) > 0.9 * np.trace(ANYWHERE)
    assert np.trace(atlas.apart(atlas.submaps[3], T)) < 1.0
    stored = Submap(9, 9, T, T)
    assert np.trace(atlas.apart(stored, T)) > 0.9 * np.trace(ANYWHERE)


def test_a_loop_ties_the_place_to_what_lies_about_it() -> None:
    atlas, T = SubmapGraph(), np.zeros(3)
    for key in range(1, 40):
        atlas.add(frame(key, T), 0.01 * np.eye(3), 0.01, anew=False)
        T = se2.compose(T, np.array((0.25, 0.0, 0.0)))
    newest = atlas.newest
    assert newest is not None
    atlas.tied, atlas.ties = newest, {1: 1e-4 * np.eye(3)}
    here = atlas.T_odom_last
    assert np.trace(atlas.apart(atlas.submaps[1], here)) == pytest.approx(
        3e-4 + np.trace(atlas.strayed_since(newest, here)), rel=0.02
    )
    assert np.trace(atlas.apart(atlas.submaps[2], here)) > 10 * np.trace(atlas.apart(atlas.submaps[1], here))
