"""What is kept of the keyframes: some of each place, however often the robot comes by."""

from __future__ import annotations

import numpy as np

from estimator import se2
from estimator.keyframe import Keyframe, keep, near
from estimator.mapping import retire
from estimator.records import Array
from estimator.state import State, new_state
from tests.estimator.world import scan_in
from tools.bench._scenes import bearings, paper_room

SCAN = scan_in(paper_room(), se2.identity(), bearings(19, 180.0), np.random.default_rng(0))


def laid(state: State, T_map: Array) -> Keyframe:
    """A keyframe there, on a submap of its own."""
    frame = keep(state.next_key, T_map, T_map, SCAN, 0.0)
    state.keyframes[frame.key] = frame
    state.next_key += 1
    retire(state, frame)
    return frame


def test_laps_beside_each_other_leave_no_more_than_the_first_ones() -> None:
    """No lap is driven quite as the last; those that touch a new square now and then must not leave a mark in it."""
    state, rng = new_state(), np.random.default_rng(4)
    kept = []
    for _ in range(120):
        for x in np.arange(rng.uniform(0.0, 0.25), 20.0, 0.25):
            laid(state, np.array((x, 0.3 + 0.08 * rng.standard_normal(), 0.1 * rng.standard_normal())))
        kept.append(len(state.keyframes))
    assert kept[0] >= 70
    assert max(kept[60:]) <= 1.05 * max(kept[:6])
    listed = sorted(key for keys in state.places.values() for key in keys if key in state.keyframes)
    assert listed == sorted(state.keyframes)
    assert sum(map(len, state.places.values())) <= 2 * len(state.keyframes)


def test_the_newest_few_of_a_place_stay() -> None:
    state = new_state()
    frames = [laid(state, np.array((0.49 + 0.01 * i, 0.0, np.pi if i % 2 else -np.pi))) for i in range(4)]
    assert list(state.keyframes) == [frame.key for frame in frames[-state.settings.keep :]]
    other = laid(state, np.array((0.5, 0.0, 0.0)))
    assert not near(frames[-1].T_map_keyframe, other.T_map_keyframe)
    assert len(state.keyframes) == state.settings.keep + 1


def test_a_keyframe_that_has_moved_with_the_map_is_found_where_it_lies_now() -> None:
    state = new_state()
    first = laid(state, np.zeros(3))
    for step in range(1, 7):  # corrections of the map carry it away little by little
        first.submap.T_map_submap = np.array((0.3 * step, 0.0, 0.0))
        laid(state, np.array((0.3 * step, 0.6, 0.0)))
    for _ in range(state.settings.keep):
        laid(state, np.array((1.8, 0.0, 0.0)))
    assert first.key not in state.keyframes
