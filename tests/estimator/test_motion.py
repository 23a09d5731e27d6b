"""The prediction: what odometry adds, whenever it begins and whatever was carried meanwhile."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from estimator import motion, se2
from estimator.motion import Motion, MotionNoise
from estimator.records import Array, Odometry

NOISE = MotionNoise()


def driving(pose: tuple[float, float, float], velocity: tuple[float, float, float], t: float = 10.0) -> Motion:
    moving = Motion(t_mono=t)
    moving.T_odom_base, moving.velocity = np.array(pose), np.array(velocity)
    return moving


def increments(begin: float, end: float, velocity: tuple[float, float, float], rate: float = 50.0) -> list[Odometry]:
    stamps = np.linspace(begin, end, round((end - begin) * rate) + 1)
    twist = np.array(velocity)
    return [Odometry(float(a), float(b), se2.exp(twist * (b - a))) for a, b in pairwise(stamps)]


def away(a: Array, b: Array) -> float:
    return float(np.hypot(*(a[:2] - b[:2])))


def test_odometry_that_begins_late_does_not_undo_the_drive() -> None:
    moving = driving((0.0, 0.0, 0.0), (0.5, 0.0, 0.1))
    for t in np.arange(10.0, 40.0, 0.025):  # half a minute on laser alone, far from where it was switched on
        motion.carry_to(moving, float(t), NOISE)
    before, t = moving.T_odom_base.copy(), moving.t_mono
    assert away(before, np.zeros(3)) > 1.0
    for record in increments(t, t + 0.5, (0.5, 0.0, 0.1)):
        motion.on_odometry(moving, record, NOISE)
        assert away(moving.T_odom_base, before) <= 0.5 * (record.t_end - t) + 0.01


def test_odometry_that_follows_replaces_the_carry() -> None:
    moving = driving((1.0, 2.0, 0.3), (0.0, 0.0, 0.0))
    start = moving.T_odom_base.copy()
    first, *others = increments(10.0, 12.0, (0.4, 0.0, 0.2))
    motion.on_odometry(moving, first, NOISE)
    for record in others:
        motion.carry_to(moving, record.t_end - 0.005, NOISE)  # a scan in between, carried at a velocity that lags
        motion.on_odometry(moving, record, NOISE)
    truth = se2.compose(start, se2.exp(np.array((0.4, 0.0, 0.2)) * 2.0))
    assert away(moving.T_odom_base, truth) < 1e-3


@pytest.mark.parametrize("silence", [0.7, 5.0, 60.0])
def test_an_increment_over_a_silence_adds_only_what_is_still_to_come(silence: float) -> None:
    moving = driving((0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    for record in increments(10.0, 11.0, (0.5, 0.0, 0.0)):
        motion.on_odometry(moving, record, NOISE)
    for t in np.arange(11.0, 11.0 + silence, 0.025):  # the laser holds the pose; here it says the robot turned round
        motion.carry_to(moving, float(t), NOISE)
    moving.T_odom_base = held = np.array((-3.0, 4.0, 2.0))
    end = moving.t_mono + 0.02
    motion.on_odometry(moving, Odometry(11.0, end, se2.exp(np.array((0.5, 0.0, 0.0)) * (end - 11.0))), NOISE)
    assert away(moving.T_odom_base, held) < 0.05


def test_an_increment_over_a_silence_of_everything_counts_whole() -> None:
    moving = driving((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for record in increments(10.0, 11.0, (0.0, 0.0, 0.0)):
        motion.on_odometry(moving, record, NOISE)
    motion.on_odometry(moving, Odometry(11.0, 21.0, np.array((3.0, 0.0, 0.0))), NOISE)
    assert moving.T_odom_base[0] == pytest.approx(3.0)
