"""The place in the map is not known: what is mapped then is a part for itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion.light_witness import blind
from estimator.fusion.map_pose import SurveyAlignment
from estimator.job_queue import SETTLE
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.keyframe import SIZE, Settled
from estimator.mapping.submap_graph import OWN
from estimator.measurements import UNLIMITED, Array, Command, Order
from estimator.numerics import se2
from estimator.pipeline import Settings, fuse_light, keyframe_poses, new_state, step
from estimator.relocalisation.landing import resettle
from estimator.relocalisation.relocalisation import begin, local_map_lost
from tests.estimator.adrift import Corners, Robot, furnished, mapped, stored, way
from tests.estimator.circuit import driven, lay, run_jobs
from tools.bench.support.scenes import Scene, box


def test_without_a_map_there_is_nothing_to_look_in() -> None:
    state = new_state()
    result = step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    assert state.map.parts.detached is None
    assert result.places is None


def test_a_robot_is_looked_for_in_a_map_of_one_submap_that_is_not_finished() -> None:
    """A map of the first seconds: nothing of it is settled when the place is lost, and it is settled then."""
    state, rng = new_state(), np.random.default_rng(3)
    places = [np.array((0.3 * k, 0.0, 0.1 * k)) for k in range(5)]
    lay(state, places[0], places[0], rng, 1)
    state.map.next_key = 2
    assert step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED).places is None, "one scan is no map"
    for key, T in enumerate(places[1:], 2):
        lay(state, T, T, rng, key)
    run_jobs(state)
    assert not state.map.graph.settled()
    state.map.next_key = 6
    assert step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED).places == 0
    lay(state, places[4], places[2], rng, 6, anew=True)
    assert [job.priority for job in run_jobs(state)] == [SETTLE]
    assert [submap.key for submap in state.map.graph.settled()] == [1]
    assert state.map.parts.detached == 2


def test_a_map_whose_first_submap_is_just_being_finished_is_one_to_be_looked_for_in() -> None:
    state, rng = new_state(), np.random.default_rng(3)
    for key in range(1, SIZE + 2):
        T = np.array((0.3 * key, 0.0, 0.1 * key))
        lay(state, T, T, rng, key)
    state.map.next_key = SIZE + 2
    assert len(state.map.graph.frames) == 1
    assert not state.map.graph.settled()
    assert step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED).places == 0


@pytest.mark.parametrize(
    ("epoch_s", "dark_s", "told"), [(0.1, 0.1, True), (0.1, 1.1, False), (2.0, 2.9, True), (2.0, 30.0, False)]
)
def test_light_holds_a_robot_that_lost_its_local_map_only_while_it_tells(
    epoch_s: float, dark_s: float, told: bool
) -> None:
    """Epochs may come slower than scans: between two of them the lamps have not gone out."""
    state, rng = new_state(lights=LightsSetup()), np.random.default_rng(3)
    assert state.light is not None
    for key in (1, 2):
        lay(state, np.array((0.3 * key, 0.0, 0.0)), np.array((0.3 * key, 0.0, 0.0)), rng, key)
    tie = state.pose.alignment = SurveyAlignment(placed=True)
    for t in (100.0 - 2.0 * epoch_s, 100.0 - epoch_s, 100.0):
        fuse_light(state, replace(state.light.result, t_mono=t))
    tie.gap = 0.0
    state.motion.t_mono, state.light.filter.t_used = 100.0 + dark_s, 100.0
    local_map_lost(state)
    assert (state.map.parts.detached is None) is told


def test_a_place_found_in_the_map_is_no_surer_in_the_survey_than_the_map_was_when_it_was_left() -> None:
    """Else a map that light had laid 5 deg askew, and had known it, comes to be believed."""
    state, _ = driven(laps=0.6)
    state.map.next_key, yaw = 1000, 0.7
    state.pose.T_map_odom = np.array((1.0, 2.0, yaw))
    left = np.array((9.0, 4.0, 1.0))
    state.pose.alignment = tie = SurveyAlignment(placed=True, P=np.eye(3), kept=(left, np.diag((0.04, 0.01, 0.02))))
    assert begin(state)
    np.testing.assert_allclose(state.relocalisation.P_left, tie.kept[1], err_msg="a blind way since is not the map's")
    tie.kept = left, np.eye(3)
    assert begin(state), "carried on: of the place meanwhile nobody knew anything"
    np.testing.assert_allclose(state.relocalisation.P_left[2, 2], 0.02)
    state.pose.T_map_odom = np.array((0.0, 0.0, -0.4))
    resettle(state, next(reversed(state.map.keyframes.values())), 1e-6 * np.eye(3), None)
    way = math.hypot(*(se2.compose(state.pose.T_map_odom, state.motion.T_odom_base) - left)[:2])
    assert way > 3.0
    assert tie.P[2, 2] < 0.03
    assert np.trace(tie.P[:2, :2]) == pytest.approx(0.05 + way**2 * 0.02, rel=0.01), (
        "a map that is askew swings by that"
    )


def test_a_robot_that_was_found_is_held_by_the_laser_though_no_scan_had_fitted_for_long() -> None:
    """Light that is just beginning would be followed away from a place that the whole map has told."""
    state, _ = driven(laps=0.6)
    state.map.next_key, state.motion.t_mono = 1000, 100.0
    state.pose.alignment = SurveyAlignment(placed=True, t_match=98.0)
    assert begin(state)
    assert blind(state.pose, state.motion)
    resettle(state, next(reversed(state.map.keyframes.values())), 1e-6 * np.eye(3), None)
    assert not blind(state.pose, state.motion)


def test_what_is_adrift_leaves_the_older_map_as_it_is() -> None:
    state, truth = driven(laps=0.6)
    state.map.next_key = 1000
    before = {key: submap.T_map_submap.copy() for key, submap in state.map.graph.submaps.items()}
    older, joined = dict(state.map.keyframes), len(state.map.graph.constraints.T)
    result = step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    assert result.places == 0
    rng = np.random.default_rng(3)
    for key in range(1000, 1000 + 3 * SIZE):  # over the same floor, as the odometry has it
        k = key - 1000
        lay(state, state.map.keyframes[k + 1].T_odom_keyframe, truth[k], rng, key)
        run_jobs(state)
    adrift = state.map.parts.detached
    assert adrift is not None
    assert {frame.submap.key for key, frame in state.map.keyframes.items() if key >= 1000} == {
        adrift,
        adrift + 1,
        adrift + 2,
    }
    sides = state.map.graph.constraints.between >= adrift
    assert (sides[:, 0] == sides[:, 1]).all()
    assert len(state.map.graph.constraints.T) >= joined
    assert older.items() <= state.map.keyframes.items()
    for key, T in before.items():
        np.testing.assert_array_equal(state.map.graph.submaps[key].T_map_submap, T)


def test_a_pose_that_is_given_moves_only_what_is_adrift_and_a_second_break_forgets_it() -> None:
    state, truth = driven(laps=0.6)
    state.map.next_key = 1000
    older = keyframe_poses(state)
    step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    adrift = state.map.parts.detached
    lay(state, truth[0], truth[0], np.random.default_rng(3), 1000)
    wanted = np.array((7.0, 8.0, 1.0))
    step(state, [Command(0.0, Order.SET_POSE, wanted)], UNLIMITED)
    np.testing.assert_allclose(se2.compose(state.pose.T_map_odom, state.motion.T_odom_base), wanted)
    np.testing.assert_allclose(state.map.keyframes[1000].T_map_keyframe, wanted)
    for key, T in older.items():
        np.testing.assert_array_equal(keyframe_poses(state)[key], T)
    step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    assert 1000 not in state.map.keyframes
    assert state.map.parts.detached == adrift


HALL = (1.0, 6.0), (10.8, 6.0), (1.0, 6.0)
TOUR = (*HALL, (1.85, 6.0), (1.85, 1.5), (1.85, 6.0), (5.85, 6.0), (5.85, 1.5), (5.85, 6.0), (9.05, 6.0), (9.05, 1.5))


@pytest.fixture(scope="module")
def floor() -> tuple[Scene, list[tuple[Array, Settled]]]:
    scene = furnished()
    return scene, mapped(scene, TOUR)


@pytest.mark.jit
@pytest.mark.parametrize("corners", [((1.85, 1.5), (1.85, 6.0), (4.0, 6.0)), ((9.0, 5.5), (9.05, 1.5)), HALL[::-1]])
def test_switched_on_anywhere_in_a_stored_map(
    floor: tuple[Scene, list[tuple[Array, Settled]]], corners: Corners
) -> None:
    scene, submaps = floor
    robot = Robot(stored(submaps), scene)
    said = robot.along(way(corners, 0.06))
    assert said[0] == 0
    assert said[-1] is None
    assert robot.off()[0] < 0.1
    assert robot.off()[1] < np.radians(1.0)
    atlas = robot.state.map.graph
    crossing = (atlas.constraints.between > len(submaps)).sum(axis=1) == 1
    assert 1 <= crossing.sum() <= 2
    assert atlas.constraints.loop[crossing].all()
    assert robot.state.pose.jumps == 1
    for key, (T, _) in enumerate(submaps, 1):
        np.testing.assert_array_equal(atlas.submaps[key].T_map_submap, T)
    fresh = [frame for key, frame in robot.state.map.keyframes.items() if key >= 1000]
    listed = {key for keys in robot.state.map.places.values() for key in keys}
    assert {frame.key for frame in fresh} <= listed


@pytest.mark.jit
def test_a_room_that_is_its_own_image_stays_ambiguous() -> None:
    """Turned by half a turn it looks the same from everywhere: no way through it tells which end is which."""
    scene = Scene(np.array(box(-3.0, -2.0, 3.0, 2.0), dtype=np.float64), (-2.5, -1.5), (2.5, 1.5))
    about = (-1.5, -1.0), (1.5, -1.0), (1.5, 1.0), (-1.5, 1.0), (-1.5, -1.0)
    robot = Robot(stored(mapped(scene, about)), scene)
    said = robot.along(way(about[1:], 0.08))
    assert set(said) == {0, 2}
    assert said[-1] == 2


@pytest.mark.jit
def test_carried_to_another_room_and_what_was_mapped_since_comes_along(
    floor: tuple[Scene, list[tuple[Array, Settled]]],
) -> None:
    scene, submaps = floor
    robot = Robot(stored(submaps), scene)
    assert robot.along(way(HALL, 0.06))[-1] is None
    detached = []
    for k, T in enumerate(way(((9.05, 1.5), (9.05, 6.0), (7.0, 6.0)), 0.06)):
        robot.at(T, carried=k == 0)
        detached.append(robot.state.map.parts.detached is not None)
    assert True in detached, "scans see through the map"
    assert not detached[-1], "found"
    assert robot.off()[0] < 0.1
    assert robot.state.matching.restarts == 1


@pytest.mark.jit
def test_in_a_part_that_is_not_mapped_nothing_is_said_until_the_robot_comes_into_one_that_is() -> None:
    scene = furnished((4.0, 3.2, 4.6, 3.8))
    west = (1.0, 6.0), (6.0, 6.0), (1.85, 6.0), (1.85, 1.5), (1.85, 6.0), (5.85, 6.0), (5.85, 1.5)
    robot = Robot(stored(mapped(scene, west)), scene)
    stays = robot.along(way(((13.65, 1.5), (13.65, 3.6), (13.65, 1.5), (13.0, 1.5)), 0.08))
    assert None not in stays
    comes = robot.along(way(((13.65, 1.5), (13.65, 6.0), (1.85, 6.0), (1.85, 1.5)), 0.1))
    assert comes[-1] is None
    assert robot.off()[0] < 0.15
    assert len(robot.state.map.graph.submaps) > len(mapped(scene, west))


@pytest.mark.jit
def test_a_person_s_word_is_looked_at_first_and_does_not_move_a_restored_map(
    floor: tuple[Scene, list[tuple[Array, Settled]]],
) -> None:
    scene, submaps = floor
    robot, T = Robot(stored(submaps), scene), np.array((1.85, 3.0, -1.5))
    robot.at(T)
    about = se2.compose(T, np.array((0.3, -0.2, 0.1)))
    said = [robot.at(T, Command(robot.t, Order.SET_POSE, about)).places] + [robot.at(T).places for _ in range(8)]
    assert said[-1] is None  # at rest, with one look
    assert robot.off()[0] < 0.1
    wrong = Robot(stored(submaps), scene)
    wrong.at(T)
    wrong.at(T, Command(wrong.t, Order.SET_POSE, np.array((9.05, 4.0, 0.0))))
    assert None not in [wrong.at(T).places for _ in range(8)]
    for key, (place, _) in enumerate(submaps, 1):
        np.testing.assert_array_equal(wrong.state.map.graph.submaps[key].T_map_submap, place)


@pytest.mark.jit
def test_a_map_that_is_only_used_never_moves_and_what_is_laid_on_top_is_bounded(
    floor: tuple[Scene, list[tuple[Array, Settled]]],
) -> None:
    scene, submaps = floor
    state = stored(submaps, Settings(localise=True))
    robot = Robot(state, scene)
    assert robot.along(way(HALL, 0.06))[-1] is None
    for T in way((*HALL, *TOUR), 0.2, 0.4):
        robot.at(T)
    assert robot.off()[0] < 0.06
    assert state.map.graph.closures > 3
    own = [key for key in state.map.graph.submaps if key > len(submaps)]
    assert max(own) - len(submaps) > OWN
    assert len(own) <= OWN + 2
    assert len([key for key in state.map.keyframes if key >= 1000]) <= OWN * SIZE
    for key, (T, settled) in enumerate(submaps, 1):
        np.testing.assert_array_equal(state.map.graph.submaps[key].T_map_submap, T)
        assert state.map.graph.submaps[key].settled is settled
