"""The place in the map is not known: what is mapped then is a part for itself."""

from __future__ import annotations

import numpy as np

from estimator import se2
from estimator.pipeline import keyframe_poses, new_state, step
from estimator.records import UNLIMITED, Command, Order
from estimator.submap import SIZE
from tests.estimator.test_closing import driven, lay, run_jobs


def test_without_a_map_there_is_nothing_to_look_in() -> None:
    state = new_state()
    result = step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    assert state.atlas.adrift is None
    assert result.places is None


def test_what_is_adrift_leaves_the_older_map_as_it_is() -> None:
    state, truth = driven(laps=0.6)
    state.next_key = 1000
    before = {key: submap.T_map_submap.copy() for key, submap in state.atlas.submaps.items()}
    older, joined = dict(state.keyframes), len(state.atlas.constraints.T)
    result = step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    assert result.places == 0
    rng = np.random.default_rng(3)
    for key in range(1000, 1000 + 3 * SIZE):  # over the same floor, as the odometry has it
        k = key - 1000
        lay(state, state.keyframes[k + 1].T_odom_keyframe, truth[k], rng, key)
        run_jobs(state)
    adrift = state.atlas.adrift
    assert adrift is not None
    assert {frame.submap.key for key, frame in state.keyframes.items() if key >= 1000} == {
        adrift,
        adrift + 1,
        adrift + 2,
    }
    sides = state.atlas.constraints.between >= adrift
    assert (sides[:, 0] == sides[:, 1]).all()
    assert len(state.atlas.constraints.T) >= joined
    assert older.items() <= state.keyframes.items()
    for key, T in before.items():
        np.testing.assert_array_equal(state.atlas.submaps[key].T_map_submap, T)


def test_a_pose_that_is_given_moves_only_what_is_adrift_and_a_second_break_forgets_it() -> None:
    state, truth = driven(laps=0.6)
    state.next_key = 1000
    older = keyframe_poses(state)
    step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    adrift = state.atlas.adrift
    lay(state, truth[0], truth[0], np.random.default_rng(3), 1000)
    wanted = np.array((7.0, 8.0, 1.0))
    step(state, [Command(0.0, Order.SET_POSE, wanted)], UNLIMITED)
    np.testing.assert_allclose(se2.compose(state.T_map_odom, state.fused.T_odom_base), wanted)
    np.testing.assert_allclose(state.keyframes[1000].T_map_keyframe, wanted)
    for key, T in older.items():
        np.testing.assert_array_equal(keyframe_poses(state)[key], T)
    step(state, [Command(0.0, Order.RELOCALISE)], UNLIMITED)
    assert 1000 not in state.keyframes
    assert state.atlas.adrift == adrift
