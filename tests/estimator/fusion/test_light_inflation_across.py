"""How far light is believed where it meets the pose and the map: across a row, at a start, of lamps that are bent."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from estimator.fusion import light_witness, map_odom_filter
from estimator.fusion.light_inflation import BENT, IN_ROW, TRUST, YOUNG, across_the_row, doubted
from estimator.light_filter.collinear_lamps import Lately, doubt
from estimator.numerics import se2
from estimator.pipeline import State, fuse_light
from estimator.result import LightsResult
from tests.estimator.fusion.test_map_odom_filter import everything, room
from tests.estimator.lit import Log, lights_at, lit_state, play

pytestmark = [pytest.mark.jit, pytest.mark.no_cover]


@pytest.fixture(scope="module")
def driven() -> tuple[State, Log]:
    run = room(1, 45.0)
    state = lit_state(run)
    return state, play(state, everything(run), run.truth)


def test_lamps_in_one_row_tell_little_across_it(driven: tuple[State, Log]) -> None:
    """Lamps 1 to 4 hang along x: y and heading are doubted, x is not; with lamp 16 as well nothing is."""
    state, T = driven[0], driven[1].results[-1].T_map_odom
    catalogue = state.light.filter.catalogue  # type: ignore[union-attr]  # lit
    lamps = catalogue.by_id
    assert len({round(lamps[k].y, 2) for k in (1, 2, 3, 4)}) == 1
    in_a_row = doubt(catalogue, frozenset((1, 2, 3, 4)))
    row = across_the_row(in_a_row, lights_at(T, frozenset((1, 2, 3, 4)), state))
    assert np.sqrt(np.diag(row.covariance)) == pytest.approx((0.05, 1.0, 0.2), abs=0.02)
    told = lights_at(T, frozenset((1, 2, 3, 4)), state)
    told = replace(told, gained=0.5 * np.linalg.inv(told.covariance), gained_by=np.array((0.02, 0.1, 0.0)))
    row = across_the_row(in_a_row, told)
    x, y, _ = (np.linalg.inv(row.covariance) @ row.gained_by / np.diag(row.gained)).tolist()
    assert (x, y) == pytest.approx((0.04, 0.2), rel=0.05), "a correction goes with what it weighs, along and across"
    grid = across_the_row(doubt(catalogue, frozenset((1, 4, 13, 16))), lights_at(T, frozenset((1, 4, 13, 16)), state))
    assert np.sqrt(np.diag(grid.covariance)) == pytest.approx((0.05, 0.05, 0.02), abs=0.005)


def test_what_light_says_of_a_keyframe_is_as_doubtful_across_a_row(driven: tuple[State, Log]) -> None:
    """It anchors the map, which would be turned to and fro between two laps by what a row of lamps cannot know."""
    state = copy.deepcopy(driven[0])
    assert state.light is not None
    T = driven[1].results[-1].T_map_odom
    assert state.pose.alignment is not None
    state.light.result = lights_at(T, frozenset((1, 2, 3, 4)), state)
    state.pose.alignment.row.take(
        doubt(state.light.filter.catalogue, state.light.result.accepted), state.pose.alignment.way
    )
    told = light_witness.virtual(state.pose, state.motion, state.light)
    assert told is not None
    assert np.sqrt(np.diag(told.covariance)) == pytest.approx((0.05, 1.0, 0.2), abs=0.02)
    assert told.accepted == {1, 2, 3, 4}


def test_what_light_says_of_a_keyframe_is_as_doubtful_as_its_lamps_are_bent(driven: tuple[State, Log]) -> None:
    state = copy.deepcopy(driven[0])
    assert state.light is not None
    assert state.pose.alignment is not None
    state.pose.alignment.way_young, state.pose.alignment.row = state.pose.alignment.way - 100.0, Lately()
    lit = lights_at(driven[1].results[-1].T_map_odom, frozenset((1, 4, 13, 16)), state)
    state.light.result = lit
    fitting = light_witness.virtual(state.pose, state.motion, state.light)
    state.light.result = replace(lit, bent=1.0)
    bent = light_witness.virtual(state.pose, state.motion, state.light)
    assert fitting is not None
    assert bent is not None
    assert bent.covariance - fitting.covariance == pytest.approx(BENT / TRUST * lit.covariance, rel=1e-3, abs=1e-6)


def test_what_light_says_of_a_keyframe_is_doubted_more_at_a_start_in_a_row(driven: tuple[State, Log]) -> None:
    state = copy.deepcopy(driven[0])
    assert state.light is not None
    assert state.pose.alignment is not None
    state.light.result = lights_at(driven[1].results[-1].T_map_odom, frozenset((1, 2, 3, 4)), state)
    state.pose.alignment.way_young = state.pose.alignment.way
    state.pose.alignment.row.take(
        doubt(state.light.filter.catalogue, state.light.result.accepted), state.pose.alignment.way
    )
    told = light_witness.virtual(state.pose, state.motion, state.light)
    assert told is not None
    assert told.covariance[0, 0] == pytest.approx(0.05**2 * (TRUST + YOUNG + IN_ROW) / TRUST, rel=0.1)


def test_a_start_in_a_row_is_doubted_more_before_it_enters_the_pose(
    driven: tuple[State, Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    state, raised = copy.deepcopy(driven[0]), list[float]()
    tie = state.pose.alignment
    assert tie is not None

    def noted(lights: LightsResult, *known: Any) -> LightsResult:
        less = doubted(lights, *known)
        raised.append(less.covariance[0, 0] / lights.covariance[0, 0])
        return less

    monkeypatch.setattr(map_odom_filter, "doubted", noted)
    T = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    for lamps in ((1, 2, 3, 4), (1, 4, 13, 16)):
        tie.way_young, tie.row = tie.way, Lately()
        fuse_light(state, lights_at(T, frozenset(lamps), state))
    assert raised == pytest.approx([TRUST + YOUNG + IN_ROW, TRUST + YOUNG], rel=0.05)


def test_light_of_bent_lamps_that_brings_nothing_is_not_taken_for_surer_than_the_pose(
    driven: tuple[State, Log],
) -> None:
    """A place taken as it is, for being much surer, would stay."""
    state = copy.deepcopy(driven[0])
    assert state.light is not None
    tie = state.pose.alignment
    assert tie is not None
    T = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    lit = replace(lights_at(T + np.array((0.1, 0.0, 0.0)), frozenset((1, 4, 13, 16)), state), bent=3.0)
    tie.way_young = tie.way
    tie.P = doubted(lit, 0.0).covariance * 0.9
    before, at = tie.P.copy(), state.pose.T_map_odom.copy()
    fuse_light(state, replace(lit, accepted=frozenset()))
    assert pytest.approx(before) == tie.P
    assert state.pose.T_map_odom == pytest.approx(at)
