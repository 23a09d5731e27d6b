"""A gyro is believed as far as it can be: a spin is followed, wrong units and damaged readings are not."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.fusion import gyro_calibration
from estimator.fusion.gyro_calibration import GyroCalibration
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


def measured(gyro: GyroCalibration, factor: float, seconds: float, begin: float = 0.0, late: int = 0) -> bool:
    """Drive with turns at 0.6 rad/s to both sides; returns whether the last reading may be used."""
    noise, used = np.random.default_rng(round(1000 * begin)), True
    times = begin + STEP * np.arange(round(seconds / STEP))
    rates = 0.6 * np.sin(0.7 * times)
    for k, t in enumerate(times.tolist()):
        read = factor * float(rates[max(k - late, 0)]) * STEP + 0.02 * STEP + noise.normal(0.0, 5e-4)
        used = gyro_calibration.usable(gyro, Imu(t, t + STEP, read))
        if k % 10 == 9:
            turned = float(rates[k - 9 : k + 1].sum()) * STEP + noise.normal(0.0, 2e-3)
            gyro_calibration.on_match(gyro, turned, 10 * STEP)
    return used


@pytest.mark.parametrize("factor", [1.0, 0.95, 1.05])
@pytest.mark.parametrize("late", [0, 10])
def test_a_sound_gyro_is_used(factor: float, late: int) -> None:
    """Also if its stamps are 0.1 s late."""
    gyro = GyroCalibration()
    assert measured(gyro, factor, 60.0, late=late)
    assert gyro.told is None


@pytest.mark.parametrize("factor", [57.3, -1.0, 2.0, 0.5, -57.3, 0.0])
def test_a_wrong_factor_is_named_as_long_as_it_lasts_and_the_gyro_is_not_used(factor: float) -> None:
    gyro = GyroCalibration()
    assert measured(gyro, 1.0, 60.0)
    assert not measured(gyro, factor, 20.0, 60.0)
    assert not measured(gyro, factor, 80.0, 80.0)
    assert gyro.told == pytest.approx(factor, rel=0.02, abs=0.02)
    assert measured(gyro, 1.0, 200.0, 160.0)


def test_a_robot_that_does_not_turn_shows_nothing_of_its_gyro() -> None:
    gyro, noise = GyroCalibration(), np.random.default_rng(1)
    for k in range(2000):
        gyro_calibration.usable(gyro, Imu(STEP * k, STEP * (k + 1), float(noise.normal(0.0, 5e-4))))
        if k % 10 == 9:
            gyro_calibration.on_match(gyro, float(noise.normal(0.0, 2e-3)), 10 * STEP)
    assert gyro.told is None
