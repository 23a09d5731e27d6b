"""Loops: keyframes whose odometry drifts, in a room whose truth is known; jobs are run where they are asked for."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion.map_pose import SurveyAlignment
from estimator.job_queue import LOST, SEARCH, SOLVE
from estimator.mapping.constraints import MANY
from estimator.mapping.keyframe import SIZE, Submap, keep, settle
from estimator.mapping.loop_closure import candidates, found_again, surer, take_answer
from estimator.mapping.loop_verification import Candidate, Found, look, look_in
from estimator.mapping.submap_graph import KEPT, SubmapGraph, alike
from estimator.measurements import Answer, Array
from estimator.numerics import se2
from estimator.relocalisation.map_reset import forget_map
from estimator.relocalisation.relocalisation import begin
from estimator.result import Loop, LoopReason, Virtual
from estimator.state import new_state
from tests.estimator.circuit import BARE, HALF, SMALL, TOLD, drifted, driven, lay, run_jobs
from tests.estimator.world import scan_in
from tools.bench.support.scenes import Scene, bearings, box, office, round_room

pytestmark = pytest.mark.jit  # whole maps; each kernel has tests of its own


def test_a_loop_brings_the_map_together_and_the_odometry_never_hears_of_it() -> None:
    state, truth = driven()
    end = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    off, drift = se2.between(truth[-1], end), se2.between(truth[-1], state.motion.T_odom_base)
    assert np.hypot(*drift[:2]) > 0.25
    assert np.hypot(*off[:2]) < 0.05
    assert abs(off[2]) < np.radians(0.7)
    np.testing.assert_array_equal(state.motion.T_odom_base, drifted(truth, 1.004, 0.0008)[-1])
    places = np.array([frame.T_map_keyframe for frame in state.map.keyframes.values()])
    assert np.hypot(*(places - truth)[:, :2].T).max() < 0.12  # the far side of the room as well
    assert state.map.graph.closures >= 3
    assert state.pose.jumps >= 1
    np.testing.assert_array_equal(state.map.T_map_start, truth[0])
    news = state.map.graph.take_news()
    assert news is not None
    assert news.counter == state.map.graph.closures
    assert news.keyframe_old < news.keyframe_new
    assert state.map.graph.take_news() is None


def test_the_pose_is_surer_after_the_loop_than_before() -> None:
    states = [state for state, _ in (driven(laps=0.9), driven())]
    before, after = (np.trace(state.map.graph.spread(state.motion.T_odom_base)[:2, :2]) for state in states)
    assert after < 0.8 * before


def test_a_correction_of_the_map_takes_nothing_from_what_is_known_of_the_pose() -> None:
    """Unless it moves the pose by more than that allows: then the pose is as uncertain as the graph has it."""
    state, vague = new_state(), np.diag((0.05**2, 0.05**2, 0.02**2))
    sharp = vague / 25.0
    state.pose.T_odom_anchor, state.pose.P_anchor = np.array((3.0, 2.0, 1.0)), sharp
    state.pose.T_map_odom = np.array((1.0, -2.0, 0.5))
    for far, expected in ((0.01, sharp), (0.1, vague)):
        before = state.pose.T_map_odom - (far, 0.0, 0.0)
        np.testing.assert_array_equal(surer(state.pose, vague, before), expected)
    state.pose.P_anchor = 4.0 * vague
    np.testing.assert_array_equal(surer(state.pose, vague, state.pose.T_map_odom), vague)


def test_without_settings_nothing_is_looked_for() -> None:
    state, _ = driven(settings=None)
    assert state.map.graph.closures == 0
    np.testing.assert_array_equal(state.pose.T_map_odom, np.zeros(3))


def test_a_large_loop_waits_for_a_second_that_agrees() -> None:
    state, _ = driven(settings=replace(TOLD, supported_m=0.0, supported_rad=0.0))
    assert state.map.graph.closures == 0  # no two agree better than by nothing
    assert len(state.map.graph.waiting) > 3
    news: list[Loop | None] = []
    state, _ = driven(settings=replace(TOLD, supported_m=0.2), news=news)
    assert state.map.graph.closures >= 2
    reasons = [loop.reason for loop in news if loop is not None]
    assert reasons[0] is LoopReason.SUPPORTED
    assert reasons[-1] is LoopReason.NEAR


def corridor(shifts: list[float], turn: float = 0.0) -> SubmapGraph:
    """Keyframes straight on, 0.25 m and a turn apart, each found so much further on than it is expected."""
    atlas, origin = SubmapGraph(), se2.identity()
    atlas.submaps = {key: Submap(key, key, origin, origin) for key in (1, 2)}
    for k, shift in enumerate(shifts):
        T = np.array((0.25 * k, 0.0, turn * k))
        moved = np.array((shift * np.cos(T[2]), -shift * np.sin(T[2]), 0.0))
        frame = replace(keep(k + 10, T, T, BARE, 0.0), submap=atlas.submaps[2])
        found_again(atlas, TOLD, frame, Found(1, se2.compose(T, moved), SMALL, 0.8, 0.0, 0.01, moved))
    return atlas


def test_a_loop_is_supported_over_as_long_a_way_as_it_moves_the_pose() -> None:
    """Where doors repeat, one door off fits as well until the robot has come to where it was said to be."""
    assert corridor([2.0] * 8).closures == 0  # 1.75 m
    assert corridor([2.0] * 9).closures == 9
    assert corridor([0.4] * 3).closures == 3
    assert corridor([6.0] * 24).closures == 0
    assert corridor([6.0] * 25).closures == 25
    assert corridor([6.0] * 3, turn=0.5).closures == 0
    assert corridor([6.0] * 4, turn=0.5).closures == 4  # what was behind has been seen


def test_whatever_is_found_elsewhere_refutes_the_loops_that_wait() -> None:
    refuted = corridor([2.0] * 6 + [0.0])
    assert (refuted.closures, len(refuted.waiting)) == (1, 0)
    assert corridor([2.0] * 6 + [0.0] + [2.0] * 8).closures == 1  # they begin again
    assert corridor([2.0] * 6 + [5.0] + [2.0] * 8).closures == 0
    assert corridor([2.0] * 6 + [5.0] + [2.0] * 9).closures == 9
    assert corridor([2.0] * 4 + [2.1] + [2.0] * 4).closures == 9  # within what agrees
    assert corridor([2.0] * 4 + [2.2] + [2.0] * 4).closures == 8  # neither agrees nor refutes


def test_what_is_accepted_by_support_refutes_the_others_too() -> None:
    """Else those go on to wait, and one more that is one door off finds them in agreement."""
    accepted = corridor([6.0] * 10 + [2.0] * 9)
    assert (accepted.closures, len(accepted.waiting)) == (9, 0)
    assert corridor([6.0] * 24 + [2.0] * 9 + [6.0]).closures == 9


def test_a_keyframe_that_fits_two_places_takes_away_what_has_agreed() -> None:
    """Where doors repeat, both places are seen once the robot has come to where its map begins."""
    atlas = corridor([2.0] * 8)
    assert len(atlas.waiting) == 8
    one = atlas.waiting[-1]
    found_again(atlas, TOLD, one.frame, replace(one.found, alone=False))
    assert (atlas.closures, len(atlas.waiting)) == (0, 0)


def test_an_answer_to_a_map_that_was_forgotten_is_dropped() -> None:
    state, truth = driven(laps=1.02)
    rng = np.random.default_rng(9)
    for key in range(1000, 1000 + 2 * SIZE):
        lay(state, state.motion.T_odom_base + np.array((0.05, 0.0, 0.0)), truth[-1], rng, key)
    late = [Answer(0.0, job.job_id, job.run()) for job in state.jobs.take()]
    assert late
    forget_map(state)
    for answer in late:
        take_answer(state.map, state.pose, state.motion, answer)
    assert not state.map.graph.submaps
    assert state.jobs.next_id > late[-1].job_id


def test_a_graph_of_which_a_part_was_forgotten_meanwhile_moves_nothing() -> None:
    """As after RELOCALISE: the newest submap then may be of an earlier run, with another odom frame."""
    state, truth = driven(laps=0.6)
    for submap in state.map.graph.submaps.values():
        submap.T_odom_submap = submap.T_odom_submap + np.array((50.0, 20.0, 1.0))
    state.map.next_key = 1000
    begin(state)
    lay(state, truth[0], truth[0], np.random.default_rng(3), 1000)
    state.map.graph.stale = True
    take_answer(state.map, state.pose, state.motion, Answer(0.0, -1, None))
    job = next(job for job in state.jobs.take() if job.priority == SOLVE)
    T_map_odom, places = (
        state.pose.T_map_odom,
        {k: one.T_map_submap for k, one in state.map.graph.submaps.items() if k != 1000},
    )
    state.map.next_key = 1001
    begin(state)
    take_answer(state.map, state.pose, state.motion, Answer(0.0, job.job_id, job.run()))
    assert state.pose.T_map_odom is T_map_odom
    assert all(places[key] is submap.T_map_submap for key, submap in state.map.graph.submaps.items())
    assert 1000 not in {key for keys in state.map.places.values() for key in keys}


def test_a_loop_of_a_forgotten_submap_whose_key_was_given_again_is_none() -> None:
    state, truth = driven(laps=0.6)
    rng, before = np.random.default_rng(3), len(state.map.graph.constraints.T)
    begin(state)
    lay(state, truth[0], truth[0], rng, 1000)
    frame = state.map.keyframes[1000]
    state.map.parts.detached_since = 1000
    begin(state)
    lay(state, truth[0], truth[0], rng, 1001)
    assert state.map.graph.submaps[frame.submap.key] is not frame.submap
    found = Found(1, np.zeros(3), SMALL, 1.0, 0.0, 0.01, np.zeros(3))
    found_again(state.map.graph, TOLD, frame, found)
    assert len(state.map.graph.constraints.T) == before


@pytest.mark.jit
def test_what_is_kept_is_bounded_by_the_area_and_stays_in_place() -> None:
    state, truth = driven(laps=4.0)
    submaps = list(state.map.graph.submaps.values())
    *_, latest, _ = submaps  # the newest is still being driven through
    assert sum(alike(submap, latest) for submap in submaps[:-1]) <= KEPT
    assert len(submaps) < 0.8 * len(truth) / SIZE
    more, _ = driven(laps=8.0)
    assert len(more.map.graph.submaps) <= 1.2 * len(submaps)
    places = np.array([frame.T_map_keyframe for frame in state.map.keyframes.values()])
    assert np.hypot(*(places - truth)[:, :2].T).max() < 0.15  # those of submaps let go included


@pytest.mark.jit
def test_what_joins_the_submaps_is_bounded_however_many_laps_are_driven() -> None:
    """The same way lap after lap: none of it may leave more behind than the lap before."""
    state, _ = driven(laps=12.0, turn=0.0)
    joined = state.map.graph.constraints
    pairs = [tuple(sorted(pair)) for pair in joined.between[~joined.loop].tolist()]
    assert len(set(pairs)) == len(pairs)
    pairs = [tuple(sorted(pair)) for pair in joined.between[joined.loop].tolist()]
    assert max(pairs.count(pair) for pair in pairs) <= MANY
    gone = [frame.submap for frame in state.map.keyframes.values() if frame.submap.into is not None]
    assert len(gone) > 100
    assert all(submap.into is not None and submap.into[0].into is None for submap in gone)


def test_a_job_that_fails_does_not_end_the_search_for_loops() -> None:
    state, truth = driven(laps=1.02)
    rng, handed = np.random.default_rng(9), []
    state.map.graph.stale = True
    take_answer(
        state.map, state.pose, state.motion, Answer(0.0, -1, None)
    )  # nobody asked: only makes the graph be handed out
    for key in range(1000, 1010 + LOST):
        lay(state, state.motion.T_odom_base, truth[-1], rng, key)
        handed.append([job.priority for job in state.jobs.take()])  # and none of them answers
    kinds = [kind for kinds in handed for kind in kinds]
    assert kinds.count(SEARCH) == 2
    assert kinds.count(SOLVE) == 1
    take_answer(state.map, state.pose, state.motion, Answer(0.0, -1, None))
    assert [job.priority for job in state.jobs.take()] == [SOLVE]
    assert len(state.jobs.pending) < 2 + LOST / SIZE + 1


def frame_at(scene: Scene, T: Array, seed: int = 0, wide: bool = False) -> tuple[Candidate, Array]:
    """A submap of keyframes about ``T`` (three of them), with the guess that a robot at ``T`` is at its origin."""
    rng = np.random.default_rng(seed)
    frames = []
    for key, dx in enumerate((-0.2, 0.0, 0.2), 1):
        T_k = se2.compose(T, np.array((dx, 0.0, 0.0)))
        frames.append(keep(key, T_k, T_k, scan_in(scene, T_k, bearings(361, 359.0) if wide else HALF, rng), 0.0))
    return Candidate(1, settle(frames, T, 0.01), np.zeros(3), np.diag((0.3**2, 0.3**2, 0.1**2))), T


def test_a_place_is_known_again_and_another_is_not() -> None:
    scene = office()
    candidate, T = frame_at(scene, np.array((3.0, 6.0, 0.3)))
    away = se2.compose(T, np.array((0.15, -0.1, 0.08)))
    frame = keep(9, away, away, scan_in(scene, away, HALF, np.random.default_rng(5)), 0.0)
    (found,) = look(frame, (candidate,), TOLD)
    assert found.reason is LoopReason.NEAR
    np.testing.assert_allclose(found.T_submap_keyframe, se2.between(T, away), atol=0.02)
    other = np.array((12.5, 9.0, -1.2))
    stranger = keep(9, other, other, scan_in(scene, other, HALF, np.random.default_rng(5)), 0.0)
    assert look_in(stranger, candidate, TOLD) is None


@pytest.mark.jit
def test_a_far_place_is_found_by_search_and_a_round_room_has_none() -> None:
    candidate, T = frame_at(office(), np.array((3.0, 6.0, 0.3)))
    unsure = replace(candidate, P=np.diag((0.8**2, 0.8**2, 0.4**2)))
    away = se2.compose(T, np.array((0.9, -0.3, 0.5)))
    frame = keep(9, away, away, scan_in(office(), away, HALF, np.random.default_rng(5)), 0.0)
    found = look_in(frame, unsure, TOLD)
    assert found is not None
    assert found.reason is LoopReason.SEARCHED
    np.testing.assert_allclose(found.T_submap_keyframe, se2.between(T, away), atol=0.03)
    room = round_room()
    candidate, T = frame_at(room, np.array((0.1, 0.0, 0.0)))
    frame = keep(9, T, T, scan_in(room, T, HALF, np.random.default_rng(5)), 0.0)
    assert look_in(frame, candidate, TOLD) is None  # no heading in a round room


def test_two_places_that_fit_close_nothing() -> None:
    """A square room looks the same from four places: known to a quarter turn it is found, else it is not."""
    scene = Scene(np.array(box(-3, -3, 3, 3), dtype=np.float64), (-2, -2), (2, 2))
    candidate, T = frame_at(scene, np.array((1.0, 0.5, 0.2)), wide=True)
    frame = keep(9, T, T, scan_in(scene, T, bearings(361, 359.0), np.random.default_rng(5)), 0.0)
    known = look_in(frame, replace(candidate, P=np.diag((0.3**2, 0.3**2, 0.3**2))), TOLD)
    assert known is not None
    np.testing.assert_allclose(known.T_submap_keyframe, np.zeros(3), atol=0.02)
    unsure = look_in(frame, replace(candidate, P=np.diag((1.5**2, 1.5**2, 1.5**2))), TOLD)
    assert unsure is not None
    assert not unsure.alone


def test_light_holds_the_map_and_the_loop_does_not_move_the_robot() -> None:
    state, truth = driven(settings=None)
    state.use(replace(state.settings, loops=TOLD))
    state.pose.alignment = SurveyAlignment(placed=True, P=np.diag((0.03**2, 0.03**2, 0.01**2)))
    for submap in state.map.graph.submaps.values():
        first = state.map.keyframes[submap.first]
        told = truth[submap.first - 1]
        first.virtual = Virtual(told, np.diag((0.04**2, 0.04**2, 0.02**2)), frozenset((1, 2, 3)))
        submap.light = told, first.virtual.covariance
    newest = state.map.graph.newest
    assert newest is not None
    held = newest.T_map_submap
    state.map.graph.stale = True
    take_answer(state.map, state.pose, state.motion, Answer(0.0, -1, None))
    run_jobs(state)
    np.testing.assert_array_equal(newest.T_map_submap, held)
    np.testing.assert_array_equal(state.pose.T_map_odom, np.zeros(3))
    firsts = [submap for submap in state.map.graph.submaps.values() if submap is not newest]
    off = np.array([se2.between(truth[submap.first - 1], submap.T_map_submap) for submap in firsts])
    drift = np.array([se2.between(truth[submap.first - 1], submap.T_odom_submap) for submap in firsts])
    assert np.hypot(*off[:-2, :2].T).mean() < 0.6 * np.hypot(*drift[:-2, :2].T).mean()


def test_light_tells_where_to_look_and_how_far() -> None:
    """The odom frame's own covariance grows with the way; a pose that light holds is looked for where light has it."""
    state, _ = driven(laps=1.02, settings=None)
    frame = next(reversed(state.map.keyframes.values()))
    state.map.graph.strayed, state.map.graph.ties = state.map.graph.strayed + np.diag((9.0, 9.0, 1.0)), {}
    state.pose.alignment = SurveyAlignment(placed=True, P=np.diag((0.03**2, 0.03**2, 0.01**2)))
    near = candidates(state.map.graph, state.pose, TOLD, frame)
    assert near
    assert all(np.trace(candidate.P) < 0.01 for candidate in near)
    state.pose.alignment.placed = False
    assert all(np.trace(candidate.P) > 10.0 for candidate in candidates(state.map.graph, state.pose, TOLD, frame))


def test_a_map_begun_anew_begins_a_submap() -> None:
    """What was laid before and after the laser lost its map must not be merged into one shape."""
    state, truth = driven(laps=0.1)
    before = state.map.graph.newest
    lay(state, state.motion.T_odom_base, truth[-1], np.random.default_rng(1), 500, anew=True)
    assert state.map.graph.newest is not before
    assert [frame.key for frame in state.map.graph.frames] == [500]
