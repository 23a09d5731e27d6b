"""The conditions of Sect. 4.3: each judges one thing, and light tells places apart that look the same."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.mapping.keyframe import Submap, keep
from estimator.mapping.loop_closure import add_keyframe, candidates, found_again
from estimator.mapping.loop_verification import BLURRED, Condition, Found, Told, look_in, passed, told_by_light
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
