"""What is kept of the keyframes: some of each place, however often the robot comes by."""

import numpy as np
import pytest

from estimator.mapping.keyframe import Keyframe, keep, near
from estimator.mapping.keyframe_selection import PASS, retire
from estimator.measurements import Array
from estimator.numerics import se2
from estimator.state import State, new_state
from tests.estimator.world import scan_in
from tools.bench.support.scenes import bearings, paper_room

SCAN = scan_in(paper_room(), se2.identity(), bearings(19, 180.0), np.random.default_rng(0))


def laid(state: State, T_map: Array) -> Keyframe:
    """A keyframe there, on a submap of its own."""
    frame = keep(state.map.next_key, T_map, T_map, SCAN, 0.0)
    state.map.keyframes[frame.key] = frame
    state.map.next_key += 1
    retire(state.map, frame)
    return frame


def test_laps_beside_each_other_leave_no_more_than_the_first_ones() -> None:
    """No lap is driven quite as the last; those that touch a new square now and then must not leave a mark in it."""
    state, rng = new_state(), np.random.default_rng(4)
    kept = []
    for _ in range(120):
        for x in np.arange(rng.uniform(0.0, 0.25), 20.0, 0.25):
            laid(state, np.array((x, 0.3 + 0.08 * rng.standard_normal(), 0.1 * rng.standard_normal())))
        kept.append(len(state.map.keyframes))
    assert kept[0] >= 70
    assert max(kept[60:]) <= 1.05 * max(kept[:6])
    listed = sorted(key for keys in state.map.places.values() for key in keys if key in state.map.keyframes)
    assert listed == sorted(state.map.keyframes)
    assert sum(map(len, state.map.places.values())) <= 2 * len(state.map.keyframes)


def swaying(x: float) -> Array:
    """2 cm to either side, once a metre."""
    return np.array((x, 0.02 * np.sin(2.0 * np.pi * x), np.arctan(0.04 * np.pi * np.cos(2.0 * np.pi * x))))


@pytest.mark.parametrize(
    "way",
    [
        [swaying(x) for x in np.arange(0.0, 20.0, 0.16)],
        [np.array((0.01 * k, 0.0, 0.26 * k)) for k in range(24)],
        [np.array((np.cos(a), np.sin(a), a + 0.5 * np.pi)) for a in np.arange(0.0, 6.2, 0.13)],
    ],
    ids=["swaying", "turning on the spot", "a circle"],
)
def test_what_is_seen_once_is_kept_however_close_together(way: list[Array]) -> None:
    state = new_state()
    for T in way:
        laid(state, T)
    assert len(state.map.keyframes) >= 0.95 * len(way)  # the end of a circle has come by its begin
    for _ in range(6):
        for T in way:
            laid(state, T)
    assert len(state.map.keyframes) <= 2 * len(way)


def test_of_earlier_passes_the_newest_stay() -> None:
    state = new_state()
    for yaw in (-np.pi, np.pi, np.pi):
        here = [laid(state, np.array((0.5, 0.0, yaw))).key]
        for x in range(PASS):
            laid(state, np.array((3.0 + x, 0.0, 0.0)))
    other = laid(state, np.array((0.5, 0.0, 0.0)))
    near_it = laid(state, np.array((0.5, 0.0, np.pi)))
    left = [frame.key for frame in state.map.keyframes.values() if near(frame.T_map_keyframe, near_it.T_map_keyframe)]
    assert left == [*here[1 - state.settings.keep :], near_it.key]
    assert other.key in state.map.keyframes


def test_a_keyframe_that_has_moved_with_the_map_is_found_where_it_lies_now() -> None:
    state = new_state()
    first = laid(state, np.zeros(3))
    for step in range(1, 7):  # corrections of the map carry it away little by little
        first.submap.T_map_submap = np.array((0.3 * step, 0.0, 0.0))
        laid(state, np.array((0.3 * step, 0.6, 0.0)))
    for _ in range(PASS + state.settings.keep):
        laid(state, np.array((1.8, 0.0, 0.0)))
    assert first.key not in state.map.keyframes


def test_the_far_end_of_a_map_that_has_turned_is_not_missed_on_the_next_pass() -> None:
    state = new_state()
    far = [laid(state, np.array((40.0 + 0.25 * k, 0.0, 0.0))) for k in range(8)]
    for frame in far:  # 0.03 rad about the robot, which is at the near end
        frame.submap.T_map_submap = np.array((frame.submap.T_map_submap[0], 1.3, 0.03))
    for k in range(20):
        laid(state, np.array((0.5 * k, 0.0, 0.0)))
    for k in range(8):
        laid(state, np.array((40.0 + 0.25 * k, 1.3, 0.03)))
    assert sum(frame.key in state.map.keyframes for frame in far) <= 4
