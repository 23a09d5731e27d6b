"""A gyro is believed as far as it can be: a spin is followed, wrong units and damaged readings are not."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.fusion.motion_model import Motion, MotionNoise, on_imu, on_odometry
from estimator.measurements import Imu, Odometry

NOISE = MotionNoise()
STEP = 0.01
SPIN_UP = np.minimum(8.0 * STEP * np.arange(1, 51), 3.0)
"""8 rad/s^2 up to 3 rad/s: quicker than a robot of this kind ever turns."""


def watched(seconds: float = 1.0) -> Motion:
    """A robot that stands, as wheels have told for a while."""
    motion = Motion()
    for k in range(round(seconds / 0.05)):
        on_odometry(motion, Odometry(0.05 * k, 0.05 * (k + 1), np.zeros(3)), NOISE)
    return motion


def turn(motion: Motion, rates: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    """Feed gyro readings at 100 Hz from where the motion stands; the heading afterwards."""
    begin = motion.t_mono
    for k, rate in enumerate(rates.tolist()):
        on_imu(motion, Imu(begin + STEP * k, begin + STEP * (k + 1), rate * STEP), NOISE)
    return float(motion.T_odom_base[2])


def test_a_spin_is_followed() -> None:
    assert turn(watched(), SPIN_UP) == pytest.approx(SPIN_UP.sum() * STEP, abs=1e-6)


def test_and_so_is_its_end() -> None:
    motion = watched()
    there = turn(motion, SPIN_UP)
    assert turn(motion, SPIN_UP[::-1]) == pytest.approx(2.0 * there, abs=0.01)


def test_a_gyro_alone_is_followed_too() -> None:
    motion = Motion()
    motion.t_mono = 0.0
    assert turn(motion, SPIN_UP) == pytest.approx(SPIN_UP.sum() * STEP, abs=1e-6)


@pytest.mark.parametrize("rate", [9.9, 60.0, -1e4, 1e7, float("nan"), float("inf")])
def test_a_damaged_reading_turns_nothing(rate: float) -> None:
    motion = watched()
    rates = np.array([0.1, 0.1, rate, rate, 0.1, 0.1])
    assert abs(turn(motion, rates)) < 0.01
    assert abs(float(motion.velocity[2])) < 0.2


def test_degrees_in_place_of_radians_turn_nothing_while_something_else_tells_the_turn() -> None:
    motion = watched()
    heading = 0.0
    for _ in range(40):  # wheels tell 0.3 rad/s, the gyro 17
        assert abs(turn(motion, np.full(5, np.degrees(0.3))) - heading) < 0.1
        end = motion.t_mono
        on_odometry(motion, Odometry(end - 0.05, end, np.array((0.0, 0.0, 0.015))), NOISE)
        heading += 0.015
        assert float(motion.T_odom_base[2]) == pytest.approx(heading, abs=1e-6)
