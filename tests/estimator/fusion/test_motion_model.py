"""The prediction: what odometry adds, whenever it begins and whatever was carried meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from estimator.fusion import motion_model, pose_update
from estimator.fusion.motion_model import Motion, MotionNoise
from estimator.measurements import Array, Odometry
from estimator.numerics import se2

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
        motion_model.carry_to(moving, float(t), NOISE)
    before, t = moving.T_odom_base.copy(), moving.t_mono
    assert away(before, np.zeros(3)) > 1.0
    for record in increments(t, t + 0.5, (0.5, 0.0, 0.1)):
        motion_model.on_odometry(moving, record, NOISE)
        assert away(moving.T_odom_base, before) <= 0.5 * (record.t_end - t) + 0.01


def test_odometry_that_follows_replaces_the_carry() -> None:
    moving = driving((1.0, 2.0, 0.3), (0.0, 0.0, 0.0))
    start = moving.T_odom_base.copy()
    first, *others = increments(10.0, 12.0, (0.4, 0.0, 0.2))
    motion_model.on_odometry(moving, first, NOISE)
    for record in others:
        motion_model.carry_to(moving, record.t_end - 0.005, NOISE)  # a scan in between, carried at a velocity that lags
        motion_model.on_odometry(moving, record, NOISE)
    truth = se2.compose(start, se2.exp(np.array((0.4, 0.0, 0.2)) * 2.0))
    assert away(moving.T_odom_base, truth) < 1e-3


@pytest.mark.parametrize("silence", [0.7, 5.0, 60.0])
def test_an_increment_over_a_silence_adds_only_what_is_still_to_come(silence: float) -> None:
    moving = driving((0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    for record in increments(10.0, 11.0, (0.5, 0.0, 0.0)):
        motion_model.on_odometry(moving, record, NOISE)
    for t in np.arange(11.0, 11.0 + silence, 0.025):  # the laser holds the pose; here it says the robot turned round
        motion_model.carry_to(moving, float(t), NOISE)
    moving.T_odom_base = held = np.array((-3.0, 4.0, 2.0))
    end = moving.t_mono + 0.02
    motion_model.on_odometry(moving, Odometry(11.0, end, se2.exp(np.array((0.5, 0.0, 0.0)) * (end - 11.0))), NOISE)
    assert away(moving.T_odom_base, held) < 0.05


def test_an_increment_over_a_silence_of_everything_counts_whole() -> None:
    moving = driving((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for record in increments(10.0, 11.0, (0.0, 0.0, 0.0)):
        motion_model.on_odometry(moving, record, NOISE)
    motion_model.on_odometry(moving, Odometry(11.0, 21.0, np.array((3.0, 0.0, 0.0))), NOISE)
    assert moving.T_odom_base[0] == pytest.approx(3.0)


def test_surprises_along_one_axis_do_not_blow_up_the_other() -> None:
    """In a corridor nothing ever takes back what is added along it; two hundred surprises across made it 10^19 m."""
    moving = Motion(P=np.diag((1e-4, 1e-4, 1e-6)), odometry=True)
    corridor = np.diag((1e-3, 1e6, 1e6))
    for k in range(200):
        correction = np.array((0.0, 0.3 * (-1) ** k, 0.0))
        lacked = motion_model.learn(moving, correction, corridor, known=False)
        assert correction @ np.linalg.inv(moving.P + lacked) @ correction <= 9.0 + 1e-6
        moving.P = pose_update.updated(moving.P + lacked, corridor, odometry=True)
        moving.P += np.diag((1e-5, 1e-5, 1e-7))
    assert moving.P[0, 0] < 1e-4 + 200 * 1.1e-5


def test_a_correction_within_three_deviations_lacked_nothing() -> None:
    moving = Motion(P=np.diag((1e-2, 1e-2, 1e-4)))
    assert not motion_model.learn(moving, np.array((0.2, -0.2, 0.0)), np.eye(3), known=False).any()


def test_an_increment_may_be_a_view_that_cannot_be_written() -> None:
    table = np.zeros((3, 2), dtype=np.int64)
    table[0, 0] = 1
    table.flags.writeable = False
    moving = Motion(t_mono=0.0)
    motion_model.on_odometry(moving, Odometry(0.0, 1.0, table[:, 0]), NOISE)
    assert moving.T_odom_base.tolist() == [1.0, 0.0, 0.0]


def test_what_a_velocity_is_wrong_by_does_not_average_out_over_many_short_carries() -> None:
    once, often = (driving((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for _ in range(2))
    for moving in (once, often):
        moving.t_told, moving.velocity_variance = 10.0, np.array((0.01, 0.01, 0.04))
    motion_model.carry_to(once, 10.1, NOISE)
    for t in np.linspace(10.0, 10.1, 11)[1:]:  # lamps, IMU readings, the scan
        motion_model.carry_to(often, float(t), NOISE)
    np.testing.assert_allclose(np.diag(often.P), np.diag(once.P), rtol=1e-6)
    assert np.sqrt(once.P[2, 2]) == pytest.approx(np.hypot(0.2 * 0.1, 2.0 * 0.1**2), rel=1e-6)


def unseen(seconds: float, cuts: int, stood_s: float = 0.0) -> Motion:
    """A robot without wheels and gyro, so long after its last match, with so many records of others in between."""
    moving = driving((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    moving.t_told, moving.t_stood, moving.velocity_variance = 10.0, 10.0 - stood_s, np.array((0.01, 0.01, 0.04))
    for k in range(1, cuts + 1):
        motion_model.carry_to(moving, 10.0 + seconds * k / cuts, NOISE)
    return moving


@pytest.mark.parametrize("stood_s", [0.0, 1.0, 30.0])
@pytest.mark.parametrize("seconds", [0.1, 0.3, 0.5, 1.0, 2.0, 10.0])
def test_what_nobody_has_watched_does_not_depend_on_how_time_is_cut(seconds: float, stood_s: float) -> None:
    once = np.diag(unseen(seconds, 1, stood_s).P)
    for cuts in (2, 7, 40, 400):
        np.testing.assert_allclose(np.diag(unseen(seconds, cuts, stood_s).P), once, rtol=1e-6)
    assert once[2] <= math.pi**2
    assert once[0] <= (0.1 * min(seconds, 0.5)) ** 2 + (0.5 * seconds) ** 2 + 1e-9, "walking pace"


def test_what_nobody_has_watched_grows_as_long_as_it_lasts_and_a_heading_up_to_any() -> None:
    P = [np.diag(unseen(seconds, 20).P) for seconds in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 4.0, 8.0)]
    for earlier, later in pairwise(P):
        assert (later > earlier).all()
    assert unseen(60.0, 600).P[2, 2] == pytest.approx(math.pi**2)


def test_a_pose_is_held_when_its_velocity_says_nothing_any_more_however_time_is_cut() -> None:
    for cuts in (1, 3, 60):
        moving = driving((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
        moving.t_told = 10.0
        for k in range(1, cuts + 1):
            motion_model.carry_to(moving, 10.0 + 3.0 * k / cuts, NOISE)
        assert moving.T_odom_base[0] == pytest.approx(0.5)


def watched(path: Callable[[float], tuple[float, float, float]], seconds: float) -> Motion:
    """A robot whose laser tells ten times a second, to a millimetre, where it is; it has no wheels."""
    moving, noise = driving((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), np.random.default_rng(1)
    before = np.array(path(0.0))
    for k in range(1, round(10.0 * seconds) + 1):
        motion_model.carry_to(moving, 10.0 + 0.1 * k, NOISE)
        moving.T_odom_base = np.array(path(0.1 * k)) + 1e-3 * noise.standard_normal(3)
        moving.P = np.diag((1e-6, 1e-6, 1e-6))
        made = se2.between(before, moving.T_odom_base)
        motion_model.feel(moving, made, (9.9 + 0.1 * k, 10.0 + 0.1 * k), 2.0 * moving.P.diagonal(), NOISE)
        before = moving.T_odom_base
    return moving


def test_a_robot_that_has_stood_may_start_at_once_but_is_not_lost_for_a_lost_scan() -> None:
    stands, drives = watched(lambda _: (1.0, 2.0, 0.5), 3.0), watched(lambda t: (0.3 * t, 0.0, 0.0), 3.0)
    crawls = watched(lambda t: (0.0, 0.0, 0.2 * t), 3.0)
    for moving in (stands, drives, crawls):
        moving.P = np.zeros((3, 3))
        motion_model.carry_to(moving, 13.2, NOISE)
    sigma = np.sqrt(np.diag(stands.P))
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(drives.P)), rtol=0.01)  # a scan or two: it may have started
    for moving in (stands, drives, crawls):
        motion_model.carry_to(moving, 14.0, NOISE)
    assert math.sqrt(stands.P[2, 2]) < 0.26, "a second without a scan"
    assert math.sqrt(drives.P[2, 2]) > 0.3
    assert math.sqrt(crawls.P[2, 2]) > 0.26, "what turns slowly does not stand"
    motion_model.carry_to(stands, 23.0, NOISE)
    assert math.sqrt(stands.P[0, 0]) > 2.0, "nobody knows for how long a robot goes on standing"


def test_how_far_a_robot_comes_that_starts_some_time_is_within_what_is_said() -> None:
    """One that has stood for T goes on for s more with the chance T / (T + s); then it turns at walking pace."""
    rng, stood = np.random.default_rng(0), 3.0
    for seconds in (0.3, 0.5, 1.0, 2.0):
        start = stood * (1.0 / (1.0 - rng.random(20000)) - 1.0)
        rate, u = 0.5 * rng.standard_normal(20000), np.maximum(0.0, seconds - start)
        turned = rate * np.maximum(0.5 * u, u - 0.25) * (u > 0.0)
        assert np.sqrt(np.mean(turned**2)) < math.sqrt(unseen(seconds, 10, stood).P[2, 2])


def test_a_velocity_that_no_scan_confirms_is_doubted_by_what_it_loses() -> None:
    moving = driving((0.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    moving.t_told, moving.velocity_variance = 10.0, np.full(3, 0.01)
    for k in range(1, 4):
        motion_model.carry_to(moving, 10.0 + 0.1 * k, NOISE)
        motion_model.slow_down(moving)
    assert moving.velocity[2] == pytest.approx(2.0 * 0.8**3)
    assert moving.velocity_variance[2] == pytest.approx(0.01 + 4.0 * (1.0 - 0.8**6))
    turned = 2.0 * 0.3 - float(moving.T_odom_base[2])  # had it gone on at its velocity
    assert turned < 1.5 * np.sqrt(moving.P[2, 2])
