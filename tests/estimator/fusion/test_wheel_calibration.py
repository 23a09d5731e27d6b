"""Online calibration of wheels and lidar mount, against a simulated drive with known errors."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from estimator import Odometry, SlowError, se2
from estimator.fusion.wheel_calibration import SOUND, WheelCalibration, corrected, on_heading, on_match, on_odometry
from estimator.numerics.arrays import Array

READING_S = 0.05
"""Period of odometry; scans come every second reading, a fifth of a period late."""


def drive(seed: int, way_m: float) -> Iterator[Array]:
    """True motion (x, y, yaw) per reading: 0.6 m/s with turns to both sides."""
    rng = np.random.default_rng(seed)
    rate, left = 0.0, 0
    for _ in range(int(way_m / (0.6 * READING_S))):
        if left == 0:
            rate, left = rng.uniform(-0.8, 0.8), int(rng.integers(20, 60))
        left -= 1
        yield np.array((0.6 * READING_S, 0.0, rate * READING_S))


def errors(distance: float = 0.0, turn: float = 0.0, drift: float = 0.0, yaw: float = 0.0, y: float = 0.0) -> Array:
    """Errors in the order of :class:`SlowError`; angles in degrees."""
    return np.array((distance, turn, math.radians(drift), math.radians(yaw), y))


def play(wheels: WheelCalibration, x: Array, seed: int, way_m: float, slip: float = 0.0, t: float = 0.0) -> float:
    """Drive with errors ``x`` (5,); ``slip``: share of readings in which the wheels turn and the robot does not."""
    rng = np.random.default_rng(seed + 1000)
    M, T = np.array((0.0, x[SlowError.MOUNT_Y], x[SlowError.MOUNT_YAW])), se2.identity()
    for number, made in enumerate(drive(seed, way_m)):
        way = float(made[0])
        measured = np.array((way / (1.0 + x[0]), 0.0, (float(made[2]) - x[2] * way) / (1.0 + x[1])))
        measured += rng.normal(0.0, (5e-4, 1e-4, 1e-3))
        slips = rng.random() < slip
        before, T = T, T if slips else se2.compose(T, made)
        if number % 2:  # a scan within this reading
            part = T if slips else se2.compose(before, 0.8 * made)
            seen = se2.compose(part, M) + rng.normal(0.0, (0.005, 0.005, 0.003))
            on_match(wheels, t + 0.8 * READING_S, seen, True)
        on_odometry(wheels, Odometry(t, t + READING_S, measured))
        t += READING_S
    return t


@pytest.mark.parametrize("seed", range(4))
def test_a_sound_robot_has_no_large_error(seed: int) -> None:
    wheels, rng = WheelCalibration(), np.random.default_rng(seed)
    t = 0.0
    for part in range(15):
        t = play(wheels, rng.normal(0.0, 0.5 * SOUND) if part == 0 else errors(), 100 * seed + part, 10.0, 0.02, t)
        assert wheels.told is None


@pytest.mark.parametrize(
    ("x", "way_m"),
    [
        (errors(distance=-0.17), 15.0),
        (errors(distance=0.2), 15.0),
        (errors(turn=0.2), 20.0),
        (errors(drift=12.0), 20.0),
        (errors(yaw=3.0), 20.0),
        (errors(yaw=-6.0), 20.0),
        (errors(yaw=10.0, y=0.05), 20.0),
        (errors(distance=0.15, turn=-0.1, yaw=5.0), 20.0),
    ],
)
def test_a_large_error_is_estimated(x: Array, way_m: float) -> None:
    wheels = WheelCalibration()
    play(wheels, x, 3, way_m)
    assert wheels.told is not None
    off, sigma = wheels.errors.x - x, np.sqrt(wheels.errors.P.diagonal())
    assert (np.abs(off) < 4.0 * sigma).all()
    assert abs(off[SlowError.MOUNT_YAW]) < math.radians(0.5) or not wheels.told.mount
    assert wheels.told.wheels == bool((np.abs(x[:3]) > 3.0 * SOUND[:3]).any())
    assert wheels.told.mount == bool((np.abs(x[3:]) > 3.0 * SOUND[3:]).any())


def test_a_mount_that_is_knocked_is_noticed_in_a_drive() -> None:
    wheels = WheelCalibration()
    t = play(wheels, errors(yaw=0.3), 5, 100.0)
    assert wheels.told is None
    play(wheels, errors(yaw=6.3), 6, 20.0, t=t)
    assert wheels.told is not None
    assert math.degrees(wheels.told.value[SlowError.MOUNT_YAW]) == pytest.approx(6.3, abs=0.5)


def jump(wheels: WheelCalibration, deg: float, rate: float = 0.3) -> None:
    """A heading jump after steady corrections of 0.1 deg at a steady turn rate (rad/s)."""
    for k in range(20):
        on_heading(wheels, math.radians(0.1 * (-1) ** k), math.radians(0.1) ** 2, rate)
    on_heading(wheels, math.radians(deg), math.radians(0.1) ** 2, rate)


@pytest.mark.parametrize("turned_deg", [-10.0, -3.0, 3.0, 6.0, 10.0])
def test_a_heading_jump_is_a_doubt_until_steps_show_whether_the_mount_has_turned(turned_deg: float) -> None:
    by_hand, knocked = WheelCalibration(), WheelCalibration()
    for wheels, yaw in ((by_hand, 0.0), (knocked, turned_deg)):
        t = play(wheels, errors(), 5, 30.0)
        assert wheels.doubt == 0.0
        jump(wheels, turned_deg)
        assert math.sqrt(wheels.doubt) == pytest.approx(math.radians(abs(turned_deg)), rel=0.01)
        play(wheels, errors(yaw=yaw), 6, 6.0, t=t)
    assert math.degrees(math.sqrt(by_hand.doubt)) < 0.7
    assert math.degrees(math.sqrt(knocked.doubt)) == pytest.approx(abs(turned_deg), abs=0.7)
    assert math.degrees(knocked.errors.x[SlowError.MOUNT_YAW]) == pytest.approx(turned_deg, abs=0.7)


def test_a_jump_back_ends_the_doubt() -> None:
    wheels = WheelCalibration()
    play(wheels, errors(), 5, 30.0)
    jump(wheels, 8.0)
    jump(wheels, -8.0)
    assert wheels.doubt == 0.0


@pytest.mark.parametrize(("deg", "before", "after"), [(1.4, 0.3, 0.3), (6.0, 0.0, 1.5)])
def test_a_small_correction_or_one_of_a_changing_turn_rate_is_no_jump(deg: float, before: float, after: float) -> None:
    """Wheels that are stamped 0.1 s late explain it."""
    wheels = WheelCalibration()
    jump(wheels, 0.1, before)
    on_heading(wheels, math.radians(deg), math.radians(0.1) ** 2, after)
    assert wheels.doubt == 0.0


def test_a_correction_undoes_the_errors_of_the_wheels() -> None:
    wheels, x = WheelCalibration(), errors(distance=-0.17, turn=0.2)
    play(wheels, x, 4, 40.0)
    fixed = corrected(wheels, Odometry(0.0, 0.1, np.array((0.1, 0.0, 0.05)))).delta
    assert float(np.hypot(*fixed[:2])) == pytest.approx(0.083, rel=0.03)
    assert fixed[2] == pytest.approx(0.06, rel=0.05)


@pytest.mark.parametrize("delta", [(math.nan, 0.0, 0.0), (math.inf, 0.0, 0.0), (1e308, -1e308, 1e308), (0.0, 0.0, 0.0)])
def test_odd_readings_change_nothing(delta: tuple[float, float, float]) -> None:
    wheels = WheelCalibration()
    play(wheels, errors(), 1, 5.0)
    before, record = wheels.errors, Odometry(100.0, 100.05, np.array(delta))
    assert np.array_equal(corrected(wheels, record).delta, record.delta, equal_nan=True) or any(delta)
    on_odometry(wheels, record)
    on_match(wheels, 100.05, se2.identity(), True)
    assert wheels.errors is before


@pytest.mark.filterwarnings("ignore:overflow|invalid")
@pytest.mark.parametrize("size", [1e6, 1e100, 1e160, 1e300, 1.7e308])
def test_readings_of_an_absurd_size_do_not_spoil_the_estimate(size: float) -> None:
    wheels = WheelCalibration()
    t = play(wheels, errors(), 1, 20.0)
    for k in range(6):
        on_odometry(wheels, Odometry(t, t + READING_S, np.array((size, -size, size))))
        t += READING_S
        on_match(wheels, t, se2.identity(), True)
        corrected(wheels, Odometry(t, t + READING_S, np.array((size, size, -size) if k % 2 else (size, 0.0, size))))
    assert np.isfinite(wheels.errors.x).all()
    play(wheels, errors(distance=0.2), 2, 40.0, t=t)
    assert wheels.told is not None
    assert wheels.errors.x[SlowError.DISTANCE] == pytest.approx(0.2, abs=0.05)


def test_a_gap_in_the_readings_ends_the_step() -> None:
    wheels = WheelCalibration()
    t = play(wheels, errors(), 1, 5.0)
    steps = wheels.steps
    play(wheels, errors(), 2, 0.3, t=t + 5.0)
    assert wheels.steps == steps
