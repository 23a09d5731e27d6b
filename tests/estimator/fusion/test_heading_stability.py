"""A heading that light tells rests, or swings."""

from __future__ import annotations

import math

from estimator.fusion.heading_stability import LOOK_M, STEP_M, SWING_RAD, Swing


def driven(*headings: float, step_m: float = 0.2, begin: float = 0.0) -> Swing:
    swing = Swing()
    for k, yaw in enumerate(headings):
        swing.take(begin + step_m * k, yaw)
    return swing


def test_a_heading_that_stays_rests_and_so_does_one_that_nothing_was_said_of() -> None:
    assert Swing().rests
    assert driven(0.5, 0.52, 0.48, 0.5 + 0.9 * SWING_RAD - 0.02).rests


def test_there_and_back_is_a_swing_until_the_way_of_it_is_behind() -> None:
    away = 0.2 + 1.1 * SWING_RAD
    assert not driven(0.2, 0.2, away, 0.2, 0.2).rests
    steps = math.ceil(LOOK_M / 0.2)
    assert not driven(0.2, away, *[0.2] * (steps - 1)).rests
    assert driven(0.2, away, *[0.2] * (steps + 2)).rests


def test_a_heading_may_pass_half_a_turn() -> None:
    assert driven(math.pi - 0.02, -math.pi + 0.02, math.pi - 0.01, 5.0 * math.pi).rests
    assert not driven(math.pi - 0.02, -math.pi + SWING_RAD).rests


def test_a_robot_at_rest_fills_no_memory_and_loses_no_swing() -> None:
    swing = Swing()
    for k in range(10_000):
        swing.take(3.0 + 1e-6 * k, 0.2 if k == 4000 else 0.0)
    assert len(swing.seen) == 1
    assert not swing.rests
    for k in range(10_000):
        swing.take(3.1 + 0.01 * k, 0.0)
    assert len(swing.seen) <= LOOK_M / STEP_M + 2
    assert swing.rests
    swing.take(200.0, 1.0)
    swing.forget()
    assert swing.rests
