"""The light filter without odometry, and at changes of the light."""

import dataclasses
import math

import numpy as np
import pytest

from estimator.light_filter import light_filter as lf
from estimator.light_filter import state_vector
from estimator.measurements import Array, Imu
from estimator.numerics import se2
from estimator.result import Fix, LinkState
from tests.estimator.light_filter.test_light_filter import follow, off, states
from tests.estimator.light_room import LAMPS, RECEIVER, SURVEY, Room, circle, drive, wheels
from tools.sim.light.link_drive import room_run

pytestmark = pytest.mark.jit


def test_without_odometry_it_follows_by_constant_velocity() -> None:
    filter_ = lf.new_lights(SURVEY)
    errors = []
    for k in range(1, 401):
        t = 0.1 * k
        result = lf.update(filter_, Room(seed=k).epoch(t, circle(t)))
        errors.append(off(result, circle(t)))
    assert result.fix is Fix.GOOD
    assert np.median([e for e, _ in errors[200:]]) < 0.08
    assert np.median([h for _, h in errors[200:]]) < math.radians(8.0)


def test_without_odometry_a_lamp_that_somebody_hides_is_paused_too() -> None:
    filter_, during, worst = lf.new_lights(SURVEY), set[LinkState | None](), 0.0
    for k in range(1, 500):
        t = 0.05 * k
        room = Room(seed=k, cover=lambda lamp, t: 0.03 if 15.0 < t < 19.0 and lamp == 6 else 1.0)
        result = lf.update(filter_, room.epoch(t, circle(t)))
        if t > 15.0:
            worst = max(worst, off(result, circle(t))[0])
        if 15.1 < t < 18.9:
            during.add(states(result).get(6))
    assert during == {LinkState.OCCLUDED}
    assert worst < 0.03


def test_without_odometry_a_robot_that_was_carried_off_finds_itself_as_soon() -> None:
    filter_ = lf.new_lights(SURVEY)
    for k in range(1, 360):
        t = 0.05 * k
        pose = circle(
            t if t < 15.0 else t + 15.0
        )  # its place grows vague while nothing fits it, and is no better for that
        result = lf.update(filter_, Room(seed=k).epoch(t, pose))
    assert off(result, pose)[0] < 0.15


def on_the_spot(t: float) -> Array:
    """Stands for a second, then turns by a radian a second, 2 cm beside its middle."""
    turned = max(t - 1.0, 0.0)
    away = 0.02 * np.array((math.sin(turned), 1.0 - math.cos(turned)))
    return np.array((4.2 + away[0], 5.6 + away[1], se2.wrap(0.3 + turned)))


@pytest.mark.parametrize("seed", [2, 4, 5])
def test_a_robot_that_sways_and_turns_on_the_spot_rules_no_heading_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lamps = [
        dataclasses.replace(
            lamp,
            power_w=lamp.power_w * math.exp(0.05 * rng.standard_normal()),
            slope_x=0.03 * rng.standard_normal(),
            slope_y=0.03 * rng.standard_normal(),
        )
        for lamp in LAMPS
    ]
    begun, filter_ = rng.uniform(0.0, 6.0, 2).tolist(), lf.new_lights(SURVEY)
    for k in range(1, 80):
        t = 0.05 * k
        pitch, roll = 0.01 * math.sin(10.7 * t + begun[0]), 0.01 * math.sin(8.2 * t + begun[1])
        receiver = dataclasses.replace(RECEIVER, slope_x=pitch, slope_y=roll)
        room = Room(lamps, dataclasses.replace(SURVEY, receiver=receiver), seed=100 * seed + k)
        lf.predict(filter_, wheels(on_the_spot, t, 0.05))
        result = lf.update(filter_, room.epoch(t, on_the_spot(t)))
    assert result.fix is not Fix.GOOD
    headings = [float(track.x[state_vector.YAW]) for track in filter_.tracks]
    assert len(headings) > 1
    assert min(abs(se2.wrap(yaw - float(on_the_spot(t)[2]))) for yaw in headings) < math.radians(20.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_without_odometry_a_lamp_that_is_too_weak_does_not_decide_for_the_mirror_image(seed: int) -> None:
    run = room_run(seed=seed, people=0)
    filter_ = lf.new_lights(run.survey)
    for epoch in run.light():
        result = lf.update(filter_, epoch)
        if result.fix is Fix.GOOD:
            break
    assert result.fix is Fix.GOOD
    assert result.t_mono < 8.0
    assert off(result, run.truth(np.array([result.t_pose]))[0])[1] < 4.0 * math.sqrt(result.covariance[2, 2])


def test_without_odometry_a_robot_that_turns_back_is_seen_to_reverse() -> None:
    filter_ = lf.new_lights(SURVEY)
    for k in range(1, 210):
        t = 0.1 * k
        u = min(max(t - 15.0, 0.0), 2.0)  # from forward to backward within two seconds
        pose = circle(min(t, 15.0) + u - 0.5 * u * u - max(t - 17.0, 0.0))
        result = lf.update(filter_, Room(seed=k).epoch(t, pose))
    assert filter_.tracks[0].x[lf.state_vector.SPEED] < -0.3
    assert off(result, pose)[1] < math.radians(15.0)


def test_lamps_switched_off_during_the_start_are_no_reason_to_look_for_ever() -> None:
    filter_, room = lf.new_lights(SURVEY), Room(cover=lambda _lamp, t: 0.0 if 3.0 < t < 63.0 else 1.0)
    for k in range(630):
        lf.update(filter_, room.epoch(0.1 * k, circle(0.0)))
    assert len(filter_.tracks) > 1
    for k in range(630, 830):
        result = lf.update(filter_, room.epoch(0.1 * k, circle(0.1 * k)))
    assert result.fix is Fix.GOOD
    assert off(result, circle(82.9))[0] < 0.15


def test_strengths_beyond_all_light_change_nothing() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 6.0)
    epoch = Room().epoch(6.1, circle(6.1))
    epoch.amplitude[:2], epoch.variance[:2] = 1e-300, 0.0
    assert np.isfinite(lf.update(filter_, epoch).covariance).all()


def test_a_gyro_gives_the_turn_and_its_bias_is_found() -> None:
    filter_ = lf.new_lights(SURVEY)
    bias = 0.01
    for t, odometry, epoch in drive(Room(), circle, 60.0):
        for j in range(10):
            a, b = t - 0.1 + 0.01 * j, t - 0.09 + 0.01 * j
            turn = se2.wrap(float(circle(b)[2] - circle(a)[2]))
            lf.predict(filter_, Imu(a, b, turn + bias * 0.01))
        wrong = dataclasses.replace(odometry, delta=odometry.delta * np.array((1.0, 1.0, 0.7)))
        lf.predict(filter_, wrong)
        result = lf.update(filter_, epoch)
    assert off(result, circle(60.0))[0] < 0.05
    assert off(result, circle(60.0))[1] < math.radians(2.0)
    assert filter_.tracks[0].x[lf.state_vector.GYRO] == pytest.approx(bias, abs=0.004)
