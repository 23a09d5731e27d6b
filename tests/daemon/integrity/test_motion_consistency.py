"""Wheels against laser: agreement, slip, echoes, and when nothing may be said."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.integrity.motion_consistency import WINDOW_S, MotionConsistency
from estimator.measurements import Array, Odometry
from estimator.numerics import se2

TWIST = np.array((0.5, 0.0, 0.4))


def drive(
    witnesses: MotionConsistency, seconds: float, wheel_twist: Array, laser_twist: Array = TWIST, lag: float = 0.0
) -> None:
    """Odometry at 50 Hz, scans at 10 Hz; the wheels may lag behind the laser."""
    for tick in range(round(seconds * 50)):
        t = 0.02 * tick
        witnesses.on_odometry(Odometry(t - lag, t + 0.02 - lag, se2.exp(0.02 * wheel_twist)))
        if tick % 5 == 4:
            witnesses.on_match(t + 0.02, se2.exp((t + 0.02) * laser_twist), True)


@pytest.mark.parametrize("scale", [1.0, 1.05, 0.95])
def test_the_same_motion_agrees_within_slip(scale: float) -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 5.0, TWIST * scale)
    assert witnesses.agree() is True


@pytest.mark.parametrize("wheels", [TWIST * 1.5, TWIST * 0.0, TWIST * [1, 1, -1], -TWIST])
def test_another_motion_disagrees(wheels: Array) -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 5.0, wheels)
    assert witnesses.agree() is False


def test_a_lag_of_the_wheels_is_not_taken_for_disagreement() -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 5.0, TWIST, lag=0.05)
    assert witnesses.agree() is True


def test_standing_still_agrees() -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 5.0, TWIST * 0, TWIST * 0)
    assert witnesses.agree() is True


def test_nothing_is_said_without_one_of_them_or_too_early() -> None:
    witnesses = MotionConsistency()
    assert witnesses.agree() is None
    drive(witnesses, 0.4 * WINDOW_S, TWIST)
    assert witnesses.agree() is None
    lonely = MotionConsistency()
    for i in range(50):
        lonely.on_match(0.1 * i, se2.exp(0.1 * i * TWIST), True)
    assert lonely.agree() is None


def test_a_match_that_took_an_axis_from_the_wheels_is_no_witness() -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 5.0, TWIST)
    witnesses.on_match(5.02, se2.exp(5.02 * TWIST), False)
    assert witnesses.agree() is None


def test_a_restart_empties_the_window() -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 5.0, TWIST)
    witnesses.restart()
    assert witnesses.agree() is None


def test_memory_stays_bounded_over_an_hour() -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 60.0, TWIST)
    assert len(witnesses._wheels) <= 2 * WINDOW_S * 50 + 2
    assert len(witnesses._laser) <= 2 * WINDOW_S * 10 + 2


def test_wheels_that_fall_silent_stop_witnessing() -> None:
    witnesses = MotionConsistency()
    drive(witnesses, 5.0, TWIST)
    for i in range(60):
        t = 5.0 + 0.1 * i
        witnesses.on_match(t, se2.exp(t * TWIST), True)
    assert witnesses.agree() is None
