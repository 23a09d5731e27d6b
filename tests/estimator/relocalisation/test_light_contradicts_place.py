"""Light against the place that is held: when it says that the robot is elsewhere, and when not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.light_filter.light_channel import too_strong_at
from estimator.numerics import se2
from estimator.relocalisation import relocalisation
from estimator.relocalisation.light_evidence import (
    MISPLACED,
    disputed,
    in_place,
    out_of_place,
)
from tests.estimator.relocalisation.test_light_evidence import HERE, anew, robot, shown, unused

pytestmark = pytest.mark.jit


def test_most_lamps_out_of_place_say_that_the_pose_is_wrong() -> None:
    state, away = shown(robot()), HERE + np.array((5.0, 0.0, 0.0))
    assert sum(too_strong_at(state.light, away)) >= MISPLACED
    state.pose.alignment.gap = None  # type: ignore[union-attr]
    assert anew(state, away), "light has several places, and holds none of them against the pose"
    state.pose.alignment.gap = 1.0  # type: ignore[union-attr]
    assert not anew(state, away)  # the lamps in use fit where the filter is; the gap to the pose says the rest
    assert anew(unused(state), away)
    assert not anew(state, HERE)


def test_lamps_exchanged_or_moved_are_not_most_of_them() -> None:
    state = unused(shown(robot()))
    assert state.light is not None
    epoch = state.light.epoch
    assert epoch is not None
    strong = too_strong_at(state.light, HERE)
    for count in range(1, len(strong)):
        amplitude = epoch.amplitude.copy()
        amplitude[np.argsort(-amplitude)[:count]] *= 100.0
        state.light.epoch = replace(epoch, amplitude=amplitude)
        told = sum(too_strong_at(state.light, HERE))
        assert anew(state, HERE) == (told >= MISPLACED and 2 * told > len(strong))


def test_a_lamp_that_was_hidden_while_it_was_learned_may_be_received_clearly_here() -> None:
    state = shown(robot())
    assert state.light is not None
    nearest = state.light.result.links[0].lamp_id
    assert nearest is not None
    state.light.filter.gains[nearest] = np.array((-3.4, 0.0, 0.0)), np.full(3, 0.01)
    assert not out_of_place(state.light, HERE)


@pytest.mark.parametrize("proved", [True, False])
def test_a_filter_led_astray_sets_no_robot_adrift_that_receives_the_lamps_of_its_place(proved: bool) -> None:
    for at, carried in ((HERE, False), (HERE + np.array((5.0, 0.0, 0.0)), True)):
        state = shown(robot())
        state.map.parts.detached, state.map.parts.detached_since, state.matching.failures = (
            None,
            0,
            relocalisation.UNFIT,
        )
        state.pose.T_map_odom = se2.compose(at, se2.inverse(state.motion.T_odom_base))
        tie, light = state.pose.alignment, state.light
        tie.placed, tie.proved = True, proved  # type: ignore[union-attr]
        light.filter.lost = True  # type: ignore[union-attr]
        assert disputed(state.light, state.map.graph)
        relocalisation.doubt(state)
        assert (state.map.parts.detached is not None) == (carried or not proved)


@pytest.mark.parametrize(("failures", "broken", "waits"), [(relocalisation.UNFIT, False, False), (0, True, True)])
def test_a_robot_carried_a_little_way_is_adrift_when_the_laser_has_lost_it(
    failures: int, broken: bool, waits: bool
) -> None:
    """Two metres beside its place the same lamps are no stronger than they may be."""
    state = shown(robot())
    state.map.parts.detached, state.map.parts.detached_since, state.matching.failures = None, 0, failures
    here = HERE + np.array((1.4, 1.2, 0.0))
    state.pose.T_map_odom = se2.compose(here, se2.inverse(state.motion.T_odom_base))
    tie, light = state.pose.alignment, state.light
    tie.placed, tie.proved, tie.broken = True, True, broken  # type: ignore[union-attr]
    light.filter.lost = True  # type: ignore[union-attr]
    assert not out_of_place(state.light, here)
    assert not in_place(state.light, here)
    assert in_place(state.light, HERE)
    relocalisation.doubt(state)
    assert (state.map.parts.detached is None) == waits
    if waits:
        state.motion.t_mono += relocalisation.ASIDE_S + 0.01
        relocalisation.doubt(state)
        assert state.map.parts.detached is not None


def test_a_robot_that_the_laser_holds_is_not_set_adrift_by_single_epochs() -> None:
    state = shown(robot())
    state.map.parts.detached, state.map.parts.detached_since = None, 0
    state.pose.T_map_odom = se2.compose(HERE + np.array((1.4, 1.2, 0.0)), se2.inverse(state.motion.T_odom_base))
    state.pose.alignment.placed = state.pose.alignment.proved = True  # type: ignore[union-attr]
    state.light.filter.lost = True  # type: ignore[union-attr]
    for _ in range(3):
        state.motion.t_mono += 2.0
        relocalisation.doubt(state)
    assert state.map.parts.detached is None
