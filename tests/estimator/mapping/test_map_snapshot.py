"""A map taken from a state, and a state made from it: the same map, whatever either does afterwards."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion.map_pose import SurveyAlignment
from estimator.light_filter import state_vector
from estimator.light_filter.gain_memory import gains_known, recall, sensors_known
from estimator.light_filter.light_channel import LightsSetup
from estimator.light_filter.light_filter import new_lights, place, predict, update
from estimator.light_filter.survey import Survey
from estimator.mapping.keyframe_selection import square_of
from estimator.mapping.map_snapshot import Identity, MapImage, finished
from estimator.measurements import Odometry
from estimator.numerics import se2
from estimator.state import State
from estimator.stored_map import image_of, restored
from tests.estimator.circuit import driven
from tests.estimator.light_room import LAMPS, RECEIVER, Room, circle

pytestmark = pytest.mark.jit

WHO = Identity(7, "ground floor", False, "", 3)


@pytest.fixture(scope="module")
def mapped() -> State:
    return driven(laps=1.3)[0]


def test_every_submap_is_in_the_image_and_all_are_settled(mapped: State) -> None:
    image = finished(image_of(mapped, WHO))
    assert [piece.key for piece in image.submaps] == list(mapped.map.graph.submaps)
    assert all(piece.settled is not None and len(piece.settled.elements) for piece in image.submaps)
    assert image.identity == WHO
    assert len(image.constraints.loop) == len(mapped.map.graph.constraints.loop)
    assert image.constraints.loop.any()


def test_keyframes_lie_in_the_image_where_they_lie_in_the_map(mapped: State) -> None:
    image = finished(image_of(mapped))
    places = {piece.key: piece.T_map_submap for piece in image.submaps}
    found = {hung.frame.key: se2.compose(places[hung.submap], hung.T_submap_keyframe) for hung in image.keyframes()}
    assert found.keys() == mapped.map.keyframes.keys()
    for key, T in found.items():
        np.testing.assert_allclose(T, mapped.map.keyframes[key].T_map_keyframe, atol=1e-9)


def test_a_restored_state_has_the_same_map_and_is_adrift(mapped: State) -> None:
    state = restored(image_of(mapped))
    assert state.map.parts.detached == 1 + max(mapped.map.graph.submaps)
    assert state.map.next_key > max(mapped.map.keyframes)
    assert state.map.keyframes.keys() == mapped.map.keyframes.keys()
    for key, frame in mapped.map.keyframes.items():
        np.testing.assert_allclose(state.map.keyframes[key].T_map_keyframe, frame.T_map_keyframe, atol=1e-9)
        assert key in state.map.places[square_of(state.map.keyframes[key].T_map_keyframe)]
    pose = se2.compose(mapped.pose.T_map_odom, mapped.motion.T_odom_base)
    np.testing.assert_allclose(se2.compose(state.pose.T_map_odom, state.motion.T_odom_base), pose, atol=1e-9)
    again = finished(image_of(state))
    assert [piece.key for piece in again.submaps] == list(mapped.map.graph.submaps)


def test_a_scan_that_only_a_submap_holds_keeps_its_number(mapped: State) -> None:
    image = image_of(mapped)
    last = max(one.settled.witness.key for one in image.submaps if one.settled is not None)
    frames = tuple(frame for frame in image.frames if frame.key < last)
    assert restored(replace(image, frames=frames)).map.next_key > last


def test_nothing_that_happens_later_changes_an_image(mapped: State) -> None:
    state = restored(image_of(mapped))
    image = image_of(state)
    before = {hung.frame.key: (hung.submap, hung.T_submap_keyframe.copy()) for hung in image.keyframes()}
    places = [piece.T_map_submap.copy() for piece in image.submaps]
    for submap in list(state.map.graph.submaps.values())[:5]:
        submap.T_map_submap = submap.T_map_submap + 1.0
        state.map.graph.drop(submap)
    after = {hung.frame.key: (hung.submap, hung.T_submap_keyframe) for hung in image.keyframes()}
    assert after.keys() == before.keys()
    for key, (submap, T) in before.items():
        assert after[key][0] == submap
        np.testing.assert_array_equal(after[key][1], T)
    for piece, T in zip(image.submaps, places, strict=True):
        np.testing.assert_array_equal(piece.T_map_submap, T)
    assert len(image.constraints.loop) == len(mapped.map.graph.constraints.loop)


def test_keyframes_of_a_submap_that_was_let_go_lie_in_the_one_that_took_its_place(mapped: State) -> None:
    state = restored(image_of(mapped))
    gone = list(state.map.graph.submaps.values())[3]
    theirs = [frame for frame in state.map.keyframes.values() if frame.submap is gone]
    state.map.graph.drop(gone)
    image = image_of(state)
    places = {piece.key: piece.T_map_submap for piece in image.submaps}
    assert gone.key not in places
    found = {hung.frame.key: se2.compose(places[hung.submap], hung.T_submap_keyframe) for hung in image.keyframes()}
    assert len(theirs) > 3
    for frame in theirs:
        np.testing.assert_allclose(found[frame.key], frame.T_map_keyframe, atol=1e-9)


def test_what_is_adrift_is_not_in_the_image(mapped: State) -> None:
    state = restored(image_of(mapped))
    last = max(state.map.graph.submaps)
    state.map.parts.detached = last
    image = finished(image_of(state))
    assert last not in {piece.key for piece in image.submaps}
    assert last not in {hung.submap for hung in image.keyframes()}
    assert last not in image.constraints.between


def test_a_map_with_nothing_in_it_is_restored_as_a_new_start() -> None:
    state = restored(MapImage(WHO))
    assert state.map.parts.detached is None
    assert not state.map.keyframes
    assert state.map.next_key == 1


def test_an_image_is_of_the_survey_once_light_has_placed_the_map(mapped: State) -> None:
    state = restored(image_of(mapped))
    state.pose.alignment, state.map.parts.detached = SurveyAlignment(placed=True), None
    assert image_of(state, WHO).identity.surveyed
    state.map.parts.detached = 3
    assert not image_of(state, WHO).identity.surveyed
    assert image_of(state, replace(WHO, surveyed=True)).identity.surveyed


def test_gains_and_sensors_are_remembered_by_the_next_run() -> None:
    weak = replace(LAMPS[5], power_w=0.8 * LAMPS[5].power_w)
    room = Room(lamps=[weak if lamp.lamp_id == weak.lamp_id else lamp for lamp in LAMPS])
    lights = new_lights(Survey(LAMPS, RECEIVER))
    place(lights, circle(0.0), np.diag((0.05**2, 0.05**2, 0.05**2)))
    for k in range(1, 800):
        t = 0.05 * k
        predict(lights, Odometry(t - 0.05, t, se2.between(circle(t - 0.05), circle(t))))
        update(lights, room.epoch(t, circle(t)))
    gains, sensors = gains_known(lights), sensors_known(lights)
    mean, variance = gains[weak.lamp_id]
    assert mean[0] == pytest.approx(np.log(0.8), abs=0.06)
    assert sensors is not None
    later = new_lights(Survey(LAMPS, RECEIVER))
    recall(later, gains, sensors, ())
    assert later.gains[weak.lamp_id][0][0] == mean[0]
    assert later.gains[weak.lamp_id][1][0] > variance[0]
    place(later, circle(0.0), np.eye(3))
    track = later.tracks[0]
    assert track.x[state_vector.COMMON] == sensors[0][state_vector.COMMON - state_vector.SCALE]
    assert 0.0 < track.P[state_vector.COMMON, state_vector.COMMON] <= lights.settings.model.common**2


def test_lamps_known_by_their_own_word_are_remembered_and_the_survey_wins() -> None:
    lights = new_lights(Survey(LAMPS[:2], RECEIVER))
    moved = replace(LAMPS[0], x=99.0)
    recall(
        lights,
        {LAMPS[2].lamp_id: (np.full(3, 0.1), np.full(3, 1e-4)), 77: (np.zeros(3), np.ones(3))},
        None,
        (moved, LAMPS[2]),
    )
    assert lights.catalogue.by_id[LAMPS[0].lamp_id].x == LAMPS[0].x
    assert lights.catalogue.by_id[LAMPS[2].lamp_id] == LAMPS[2]
    assert lights.gains.keys() == {LAMPS[2].lamp_id}


def test_a_lit_state_is_restored_with_its_gains(mapped: State) -> None:
    gains = {LAMPS[0].lamp_id: (np.full(3, 0.2), np.full(3, 1e-4))}
    image = replace(image_of(mapped), gains=gains)
    state = restored(image, lights=LightsSetup(Survey(LAMPS, RECEIVER)))
    assert state.light is not None
    assert state.pose.alignment is not None
    assert state.light.filter.gains[LAMPS[0].lamp_id][0][0] == 0.2
    assert state.pose.alignment.since == state.map.next_key
    np.testing.assert_array_equal(state.relocalisation.P_left, image.P)
    assert image.P.any()
