"""Protection levels: quantiles, what a wrong witness adds, what one witness alone is worth."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from estimator.cdma.epoch import BlockFlag
from estimator.fusion import protection_level
from estimator.fusion.light_inflation import without_heading
from estimator.fusion.light_witness import holds_heading
from estimator.fusion.map_odom_history import SPACING_M, MapOdomHistory
from estimator.fusion.map_pose import SurveyAlignment
from estimator.fusion.protection_level import ALONE, FAULTY, K_FAULT, K_PLAIN, RISK, UNKNOWN_M, bound, spread
from estimator.light_filter.light_channel import LightsSetup
from estimator.light_filter.survey import Survey
from estimator.measurements import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import Fix, LightsResult, Protection
from estimator.state import State, new_state

P = np.diag((0.02**2, 0.03**2, 0.01**2))


def lights(T: Array, covariance: Array) -> LightsResult:
    gained = 0.2 * invert3(covariance)
    return LightsResult(
        1.0, Fix.GOOD, T, covariance, (), frozenset((1, 2, 3)), gained, np.array((0.01, 0.0, 0.02)),
        block=BlockFlag.NONE, t_pose=1.0,
    )  # fmt: skip


def lit(light_at: tuple[float, float, float] = (0.0, 0.0, 0.0), wheels: bool = True) -> State:
    """A robot at the origin that light has placed and the laser holds."""
    state = new_state(lights=LightsSetup(Survey()))
    tie = cast(SurveyAlignment, state.pose.alignment)
    tie.placed = tie.proved = True
    tie.P, tie.way = P.copy(), 100.0
    state.motion.t_mono = state.matching.t_match = tie.t_match = 1.0
    state.motion.odometry = wheels
    state.matching.local_map = cast(Any, SimpleNamespace())
    assert state.light is not None
    state.light.filter.course.wheels = wheels
    state.light.result = lights(np.array(light_at), P)
    return state


def held_by(state: State) -> Protection | None:
    """The bound as a step asks for it."""
    return bound(
        state.pose,
        state.motion,
        state.light,
        state.matching,
        state.pose.covariance(state.motion.T_odom_base, state.motion.P),
    )


def test_the_quantiles_are_those_of_the_stated_risk() -> None:
    """A Gaussian error in the plane leaves K sigma with half the risk; of two witnesses each takes a quarter."""
    assert math.exp(-0.5 * (K_PLAIN / protection_level.ALIKE) ** 2) == pytest.approx(0.5 * RISK)
    assert FAULTY * math.exp(-0.5 * (K_FAULT / protection_level.ALIKE) ** 2) == pytest.approx(0.25 * RISK)
    far, turned = spread(np.array(((2.0, 1.0, 0.0), (1.0, 2.0, 0.0), (0.0, 0.0, 0.25))), 2.0)
    assert far == pytest.approx(2.0 * math.sqrt(3.0)), "the larger axis, whichever way it lies"
    assert turned == pytest.approx(1.0)


def test_a_hundred_thousand_gaussian_errors_are_within_it() -> None:
    errors = np.random.default_rng(3).standard_normal((100_000, 2)) * 0.03
    held = held_by(lit())
    assert held is not None
    assert np.hypot(*errors.T).max() < held.horizontal_m


def test_light_whose_lamps_are_bent_or_in_a_row_bounds_it_less_at_a_start() -> None:
    def level(bent: float, in_row: bool) -> float:
        state = lit()
        tie = cast(SurveyAlignment, state.pose.alignment)
        tie.way_young = tie.way
        tie.row.left = np.diag((1.0, 1.0, 0.2**2)) * float(in_row)
        assert state.light is not None
        state.light.result = replace(state.light.result, bent=bent)
        held = held_by(state)
        assert held is not None
        return held.horizontal_m

    usual = level(0.0, in_row=False)
    assert level(3.0, in_row=False) > 1.3 * usual
    assert level(0.0, in_row=True) > 1.2 * usual


def test_two_witnesses_that_agree_bound_it_by_the_covariance() -> None:
    held = held_by(lit())
    assert held is not None
    assert (held.laser, held.light, held.wheels) == (True, True, True)
    assert held.horizontal_m == pytest.approx(UNKNOWN_M + K_PLAIN * 0.03)
    assert 0.0 < held.yaw_rad < 0.2


@pytest.mark.parametrize("off", [0.5, 2.0])
def test_light_elsewhere_moves_the_bound_out_to_there(off: float) -> None:
    held = held_by(lit((off, 0.0, 0.0)))
    assert held is not None
    assert off < held.horizontal_m < off + 1.0


def test_without_wheels_light_says_nothing_against_the_heading() -> None:
    with_wheels, without = held_by(lit((0.0, 0.0, 3.0))), held_by(lit((0.0, 0.0, 3.0), wheels=False))
    assert with_wheels is not None
    assert without is not None
    assert with_wheels.yaw_rad > 3.0 > without.yaw_rad


def test_a_pose_that_light_has_drawn_away_from_the_laser_is_bounded_by_both() -> None:
    state = lit()
    held_by(state)
    state.matching.steps += SPACING_M + 1.0
    state.pose.T_map_odom = np.array((0.8, 0.0, 0.0))
    assert state.light is not None
    state.light.result = lights(np.array((0.8, 0.0, 0.0)), P)
    held = held_by(state)
    assert held is not None
    assert held.horizontal_m > 0.8, "light may have gone wrong: the laser alone would be 0.8 m away"
    state.pose.history.forget()
    again = held_by(state)
    assert again is not None
    assert again.horizontal_m < 0.5


def test_one_witness_alone_bounds_less() -> None:
    state = lit()
    assert state.light is not None
    both = held_by(state)
    state.matching.t_match = -math.inf
    dark = held_by(state)
    assert both is not None
    assert dark is not None
    assert not dark.laser
    assert dark.horizontal_m == pytest.approx(UNKNOWN_M + ALONE * K_PLAIN * 0.03)


def test_a_pose_that_may_be_anywhere_has_no_bound() -> None:
    state = lit()
    cast(SurveyAlignment, state.pose.alignment).P = np.diag((100.0, 100.0, 9.0))
    assert held_by(state) is None


def test_ties_are_kept_for_one_to_two_stretches() -> None:
    frozen = MapOdomHistory()
    for way in np.arange(0.0, 100.0, 0.5):
        frozen.take(np.zeros(3), P, float(way))
        assert len(frozen.kept) <= 2
        assert way - frozen.kept[0][2] <= 2.0 * SPACING_M
        assert way < SPACING_M or way - frozen.kept[0][2] >= SPACING_M


def heading_held(state: State) -> bool:
    return holds_heading(state.pose, state.motion, state.light)


def test_the_laser_holds_a_heading_only_where_no_wheels_do() -> None:
    assert heading_held(lit(wheels=False))
    assert not heading_held(lit(wheels=True))
    lost = lit(wheels=False)
    cast(SurveyAlignment, lost.pose.alignment).broken = True
    assert not holds_heading(lost.pose, lost.motion, lost.light)


def test_light_without_its_heading_tells_the_position_as_before() -> None:
    covariance = np.array(((4e-4, 1e-4, 2e-4), (1e-4, 9e-4, 0.0), (2e-4, 0.0, 4e-3)))
    before = lights(np.array((1.0, 2.0, 3.0)), covariance)
    after = without_heading(before)
    np.testing.assert_allclose(after.covariance[:2, :2], covariance[:2, :2])
    assert after.covariance[2, 2] > 3.0
    assert np.linalg.eigvalsh(after.gained).min() > -1e-9
    assert after.gained[2, 2] < 1e-3 * before.gained[2, 2]
    assert after.gained_by[2] == 0.0
