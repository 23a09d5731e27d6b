"""A gyro is believed as far as it can be: a spin is followed, wrong units and damaged readings are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from estimator.fusion import gyro_calibration
from estimator.fusion.gyro_calibration import GyroCalibration
from estimator.fusion.motion_model import Motion, MotionNoise, on_imu, on_odometry
from estimator.measurements import Imu, Odometry
from estimator.numerics import se2

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


def sine(t: float) -> float:
    """Turn rate (rad/s) of a drive with turns to both sides."""
    return 0.6 * float(np.sin(0.7 * t))


def measured(
    gyro: GyroCalibration,
    rate: Callable[[float], float],
    factor: float = 1.0,
    span: tuple[float, float] = (0.0, 60.0),
    hz: int = 10,
    late_s: float = 0.0,
    waits: int = 0,
    knocked: float = 0.0,
) -> list[float]:
    """Play readings at 200 Hz and matches with a noise of 2 mrad; returns the factors named after each match.

    ``late_s``: of the gyro's stamps. ``waits``: matches by which scans arrive late. ``knocked``: the lidar mount at the
    middle, rad.
    """
    noise, dt, named = np.random.default_rng(round(1000 * span[0])), 0.005, []
    heading = sum(rate(dt * k) * dt for k in range(round(span[0] / dt)))
    matches: list[tuple[float, float]] = []
    for k in range(round((span[1] - span[0]) / dt)):
        t = span[0] + dt * k
        reading = Imu(t, t + dt, factor * rate(t - late_s) * dt + 0.02 * dt + float(noise.normal(0.0, 2e-4)))
        used = gyro_calibration.usable(gyro, reading)
        assert used is (gyro.told is None and abs(reading.dyaw) < 10.0 * dt)
        heading += rate(t) * dt
        if (k + 1) % round(1.0 / hz / dt) == 0:
            off = knocked if t > 0.5 * sum(span) else 0.0
            matches.append((t + dt, se2.wrap(heading + off + float(noise.normal(0.0, 2e-3)))))
            if len(matches) > waits:
                gyro_calibration.on_match(gyro, *matches.pop(0))
                named += [] if gyro.told is None else [gyro.told]
    return named


@pytest.mark.parametrize("factor", [1.0, 0.95, 1.05])
@pytest.mark.parametrize("late_s", [0.0, 0.1, -0.1])
@pytest.mark.parametrize("hz", [10, 40])
def test_a_sound_gyro_is_used(factor: float, late_s: float, hz: int) -> None:
    """Also if its stamps, or those of the lidar, are 0.1 s late."""
    assert not measured(GyroCalibration(), sine, factor, hz=hz, late_s=late_s)


@pytest.mark.parametrize("factor", [57.3, -1.0, 2.0, 0.5, -57.3, 0.0])
@pytest.mark.parametrize("waits", [0, 8])
def test_a_wrong_factor_is_named_as_long_as_it_lasts(factor: float, waits: int) -> None:
    """Also where every scan arrives 0.8 s after the readings of its instant."""
    gyro = GyroCalibration()
    assert not measured(gyro, sine, waits=waits)
    assert measured(gyro, sine, factor, (60.0, 80.0), waits=waits)
    named = measured(gyro, sine, factor, (80.0, 160.0), waits=waits)
    assert len(named) == 800 - waits
    assert named[-1] == pytest.approx(factor, rel=0.02, abs=0.02)
    measured(gyro, sine, 1.0, (160.0, 220.0), waits=waits)
    assert gyro.told is None


@pytest.mark.parametrize("factor", [57.3, -1.0, 2.0, 0.5, 0.0])
def test_a_wrong_factor_is_named_in_the_first_turn_after_a_straight_drive(factor: float) -> None:
    assert measured(GyroCalibration(), lambda t: 0.8 if 10.0 < t < 12.0 else 0.0, factor, (0.0, 14.0))


@pytest.mark.parametrize("hz", [10, 40])
@pytest.mark.parametrize("knocked", [0.0, 0.1, -0.2])
def test_noise_of_matches_and_a_knocked_mount_are_no_error_of_the_gyro(hz: int, knocked: float) -> None:
    assert not measured(GyroCalibration(), lambda _: 0.0, span=(0.0, 30.0), hz=hz, knocked=knocked)


@pytest.mark.parametrize("late_s", [0.1, -0.1])
@pytest.mark.parametrize("seed", range(6))
def test_a_time_offset_in_a_drive_of_sharp_turns_is_no_error_of_the_gyro(late_s: float, seed: int) -> None:
    """The turn rate changes in steps, often after a rest."""
    drawn = np.random.default_rng(seed)
    ends, rates = np.cumsum(drawn.uniform(0.3, 4.0, 60)), drawn.uniform(-1.5, 1.5, 61)
    rates[drawn.random(61) < 0.5] = 0.0
    assert not measured(GyroCalibration(), lambda t: float(rates[np.searchsorted(ends, t)]), hz=40, late_s=late_s)


def test_a_gyro_whose_readings_arrive_after_the_scan_is_compared_too() -> None:
    gyro = GyroCalibration()
    for k in range(400):
        t = 0.05 * (k + 1)
        gyro_calibration.on_match(gyro, t, 0.6 * float(np.sin(t)))
        before = t - 0.05
        gyro_calibration.usable(gyro, Imu(before - 0.2, t - 0.2, -0.6 * float(np.sin(t - 0.2) - np.sin(before - 0.2))))
    assert gyro.told == pytest.approx(-1.0, abs=0.02)
