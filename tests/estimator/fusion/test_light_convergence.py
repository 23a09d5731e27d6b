"""Whether pose and light are on their way to one another."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion import light_witness, map_odom_filter
from estimator.fusion.heading_stability import SWING_RAD
from estimator.fusion.map_odom_filter import APART
from estimator.measurements import Array, Command, Order
from estimator.numerics import se2
from estimator.pipeline import fuse_light
from estimator.result import SURPRISE, Fix, LightsResult
from estimator.state import State
from tests.estimator.lit import lights_at, lit_state, play, scans, together
from tools.sim.light.link_drive import room_run

pytestmark = [pytest.mark.jit, pytest.mark.no_cover]


@pytest.fixture(scope="module")
def driven() -> State:
    run = replace(room_run(seed=1, people=0), seconds=30.0)
    state = lit_state(run)
    play(state, together(run.odometry(), run.light(), scans(run)), run.truth)
    return state


def epoch_of(state: State, off: Array, fix: Fix = Fix.GOOD) -> LightsResult:
    """The next epoch, which finds the robot by so much beside the pose, its heading to 5 deg, and adds nothing."""
    assert state.pose.alignment is not None
    here = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base) + off
    P = np.diag((0.05**2, 0.05**2, 0.09**2))
    return replace(lights_at(here, frozenset((1, 4, 13, 16)), state), fix=fix, covariance=P)


def test_pose_and_light_are_apart_where_they_agree_no_better_than_by_chance(driven: State) -> None:
    state = copy.deepcopy(driven)
    tie = state.pose.alignment
    assert tie is not None
    assert not tie.apart, "after a whole drive in good light"
    fuse_light(state, epoch_of(state, np.array((0.0, 0.2, 0.0))))
    assert tie.gap is not None
    assert APART < tie.gap < SURPRISE
    assert tie.apart
    fuse_light(state, epoch_of(state, np.zeros(3), Fix.HELD))
    assert tie.gap is None
    assert tie.apart, "what light said last counts while it says nothing"
    fuse_light(state, epoch_of(state, np.zeros(3)))
    assert not tie.apart


def test_pose_and_light_are_apart_while_light_swings_and_that_ends_with_an_order(driven: State) -> None:
    state = copy.deepcopy(driven)
    tie = state.pose.alignment
    assert tie is not None
    assert state.light is not None
    for turn in (0.0, SWING_RAD + 0.01, 0.0):
        fuse_light(state, epoch_of(state, np.array((0.0, 0.0, turn))))
    assert tie.apart
    T = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    map_odom_filter.on_order(state.pose, state.motion, state.light, Command(state.motion.t_mono, Order.SET_POSE, T))
    assert not tie.apart
    fuse_light(state, epoch_of(state, np.zeros(3)))
    assert not tie.apart


def test_a_pose_that_the_map_has_told_may_be_as_far_from_light_as_chance_will_have_it(
    driven: State,
) -> None:
    state = copy.deepcopy(driven)
    tie = state.pose.alignment
    assert tie is not None
    map_odom_filter.place_given(tie, by_map=True)
    fuse_light(state, epoch_of(state, np.array((0.0, 0.2, 0.0))))
    assert not tie.apart
    fuse_light(state, epoch_of(state, np.array((0.0, 1.0, 0.0))))
    assert tie.apart, "no chance"


def test_a_heading_from_light_that_is_not_used_swings_in_vain(driven: State) -> None:
    state = copy.deepcopy(driven)
    tie = state.pose.alignment
    assert tie is not None
    assert state.light is not None
    state.light.filter.course.wheels = False
    assert light_witness.holds_heading(state.pose, state.motion, state.light)
    for turn in (0.0, SWING_RAD + 0.01, 0.0):
        fuse_light(state, epoch_of(state, np.array((0.0, 0.0, turn))))
    assert not tie.apart
