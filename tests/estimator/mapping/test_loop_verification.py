"""Candidates of loops: verification, and the constraints that follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Submap, keep
from estimator.mapping.loop_closure import add_keyframe, candidates, found_again
from estimator.mapping.loop_verification import BLURRED, Condition, Found, Told, look_in, passed, told_by_light
from estimator.mapping.pose_graph import UPPER, Graph, optimise
from estimator.measurements import Array
from estimator.numerics import se2
from estimator.result import LoopReason, Virtual
from tests.estimator.circuit import HALF, SMALL, TOLD, driven
from tests.estimator.mapping.test_loop_closure import frame_at
from tests.estimator.world import scan_in
from tools.bench.support.scenes import Scene, bearings, box, paper_room


def found_with(**other: object) -> Found:
    """A place that passes every condition, but for what is given."""
    good = Found(1, np.zeros(3), SMALL, 0.9, 0.0, 0.01, np.zeros(3), light=1.0)
    return replace(good, **other)  # type: ignore[arg-type]  # names are checked by replace


@pytest.mark.parametrize(
    ("condition", "bad"),
    [
        (Condition.IDS, {"shared": 0.9}),
        (Condition.LIGHT, {"light": 17.0}),
        (Condition.PLACE, {"off": 26.0}),
        (Condition.SSE, {"residual_m": 0.07}),
        (Condition.OVERLAP, {"share": 0.6}),
        (Condition.AGAINST, {"against": 0.06}),
        (Condition.RANK, {"known": False}),
    ],
    ids=lambda value: value.name if isinstance(value, Condition) else "",
)
def test_each_condition_is_asked_only_where_it_is_switched_on(condition: Condition, bad: dict[str, object]) -> None:
    every = replace(TOLD, conditions=frozenset(Condition))
    assert passed(found_with(), every)
    assert not passed(found_with(**bad), every)
    assert not passed(found_with(**bad), replace(TOLD, conditions=frozenset((condition,))))
    assert passed(found_with(**bad), replace(TOLD, conditions=frozenset(Condition) - {condition}))


def test_light_that_is_paused_leaves_the_loop_to_the_laser() -> None:
    assert passed(found_with(light=None), replace(TOLD, conditions=frozenset(Condition)))
    submap = Submap(1, 1, np.zeros(3), np.zeros(3), light=(np.zeros(3), SMALL), lamps=frozenset((1, 2, 3, 4, 5)))
    T = np.array((0.3, 0.0, 0.1))
    scan = scan_in(paper_room(), T, HALF, np.random.default_rng(1))
    frame = keep(2, T, T, scan, 0.0)
    assert told_by_light(frame, submap, TOLD) is None
    frame.virtual = Virtual(T, SMALL, frozenset((1, 2, 3)))
    assert told_by_light(frame, submap, TOLD) is None  # fewer links than Link_n
    frame.virtual = Virtual(T, SMALL, frozenset((1, 2, 3, 9)))
    said = told_by_light(frame, submap, TOLD)
    assert said is not None
    assert said.shared == 0.75
    np.testing.assert_allclose(said.T_submap_keyframe, T)


def test_the_error_of_light_at_a_submap_moves_what_is_seen_from_it() -> None:
    """Drawn: places by light of both, and how the one spreads as seen from the other."""
    rng = np.random.default_rng(5)
    P_old, P_new = np.diag((0.03, 0.05, 0.04)) ** 2, np.diag((0.06, 0.02, 0.03)) ** 2
    T_old, T_new = np.array((3.0, -1.0, 2.0)), np.array((5.0, 1.5, 0.5))
    submap = Submap(1, 1, T_old, T_old, light=(T_old, P_old), lamps=frozenset(range(4)))
    frame = keep(2, T_new, T_new, scan_in(paper_room(), np.zeros(3), HALF, rng), 0.0)
    frame.virtual = Virtual(T_new, P_new, frozenset(range(4)))
    said = told_by_light(frame, submap, TOLD)
    assert said is not None
    drawn = [
        se2.between(
            T_old + rng.multivariate_normal(np.zeros(3), P_old), T_new + rng.multivariate_normal(np.zeros(3), P_new)
        )
        for _ in range(4000)
    ]
    spread = np.cov(np.array(drawn).T)
    np.testing.assert_allclose(0.5 * (said.P - BLURRED), spread, atol=0.1 * spread.max())


@pytest.mark.jit
def test_light_tells_a_room_from_its_mirror_image() -> None:
    """Known to nothing, a square room fits at every quarter turn; what light said of both places leaves one."""
    scene = Scene(np.array(box(-3, -3, 3, 3), dtype=np.float64), (-2, -2), (2, 2))
    candidate, T = frame_at(scene, np.array((1.0, 0.5, 0.2)), wide=True)
    frame = keep(9, T, T, scan_in(scene, T, bearings(361, 359.0), np.random.default_rng(5)), 0.0)
    lost = replace(candidate, P=np.diag((1.5**2, 1.5**2, 1.5**2)))
    either = look_in(frame, lost, TOLD)
    assert either is not None
    assert not either.alone
    told = Told(np.array((0.1, -0.05, 0.05)), np.diag((0.1**2, 0.1**2, 0.05**2)), 1.0)
    found = look_in(frame, replace(lost, told=told), TOLD)
    assert found is not None
    assert found.reason is LoopReason.LIT
    np.testing.assert_allclose(found.T_submap_keyframe, np.zeros(3), atol=0.02)
    wrong = replace(told, T_submap_keyframe=np.array((0.0, 0.0, 0.8)))
    assert look_in(frame, replace(lost, told=wrong), TOLD) is None


def test_with_light_a_loop_that_moves_the_pose_far_needs_no_second_one() -> None:
    state, _ = driven(laps=0.9)
    key = next(iter(state.map.graph.submaps))
    frame = next(reversed(state.map.keyframes.values()))
    far = found_with(key=key, moved=np.array((0.5, 0.0, 0.0)))
    before = state.map.graph.closures
    found_again(state.map.graph, TOLD, frame, far)
    assert state.map.graph.closures == before
    found_again(state.map.graph, TOLD, frame, replace(far, reason=LoopReason.LIT))
    assert state.map.graph.closures == before + 1


def test_a_submap_knows_the_lamps_of_all_its_keyframes() -> None:
    state, truth = driven(laps=0.05)
    newest = state.map.graph.newest
    assert newest is not None
    scan = scan_in(paper_room(), truth[-1], HALF, np.random.default_rng(1))
    for key, lamps in ((700, (1, 2)), (701, (2, 3))):
        frame = keep(key, truth[-1], state.motion.T_odom_base, scan, 0.0)
        frame.virtual = Virtual(truth[-1], SMALL, frozenset(lamps))
        add_keyframe(state.map, state.pose, frame, (SMALL, 0.01, False))
    assert newest.lamps == {1, 2, 3}


def test_of_submaps_at_one_place_those_that_look_the_same_way_come_first() -> None:
    """A lidar of 180 deg sees little of what one saw that came the other way."""
    state, _ = driven(laps=1.02, settings=None)
    frame = next(reversed(state.map.keyframes.values()))
    (nearest, *_) = candidates(state.map.graph, state.pose, replace(TOLD, turned_m=2.0), frame)
    back = next(s for s in state.map.graph.submaps.values() if s.key == nearest.key)
    assert back.settled is not None
    turn = np.array((0.0, 0.0, np.pi))
    twin = Submap(99, back.first, back.T_map_submap, back.T_odom_submap)
    placed = se2.compose(back.settled.witness.T_odom_keyframe, turn)
    twin.settled = replace(back.settled, witness=replace(back.settled.witness, T_odom_keyframe=placed))
    state.map.graph.submaps = {99: twin} | state.map.graph.submaps
    found = [
        candidate.key
        for candidate in candidates(state.map.graph, state.pose, replace(TOLD, candidates=9, turned_m=2.0), frame)
    ]
    assert found.index(back.key) < found.index(99)


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
