"""The drive is smooth, keeps its limits and returns; the wheels err as much as they are told to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tools.sim.building.buildings import BUILDINGS, building
from tools.sim.building.world import Array, Plan
from tools.sim.robot.drive import Body, Drive, Route
from tools.sim.robot.odometry import Odometer, Wheels

BODY = Body()
SQUARE = Route(((2.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0), (0.0, 0.0)))
PERFECT = Wheels(tick_m=1e-9, scale=0.0, base_scale=0.0, noise=0.0, slips_per_m=0.0)


def test_paper_drive_is_160_m_and_returns_to_its_start() -> None:
    drive = Drive(building("paper_room").route, BODY, laps=1)
    assert drive.length_m == pytest.approx(160.0, abs=2.0)
    begin, end = drive.pose(np.array([0.0, drive.lap_s + 1.0]))
    np.testing.assert_allclose(end[:2], begin[:2], atol=1e-9)
    assert np.cos(end[2] - begin[2]) == pytest.approx(1.0)
    walked = np.hypot(*np.diff(drive.pose(np.arange(0.0, drive.lap_s, 0.02))[:, :2], axis=0).T).sum()
    assert walked == pytest.approx(drive.length_m, abs=0.05)


@pytest.mark.parametrize("name", sorted(BUILDINGS))
def test_drive_keeps_the_body_s_limits(name: str) -> None:
    drive = Drive(building(name).route, BODY)
    t = np.arange(0.0, drive.lap_s, 0.02)
    v, turn = drive.twist(t).T
    assert np.all(v >= 0.0)
    assert v.max() == pytest.approx(BODY.speed)
    assert np.abs(turn).max() <= BODY.turn_rate * 1.01
    assert np.abs(np.diff(v)).max() / 0.02 <= BODY.acceleration * 1.05
    pose = drive.pose(t)
    speed = np.hypot(*np.diff(pose[:, :2], axis=0).T) / 0.02
    np.testing.assert_allclose(speed, 0.5 * (v[1:] + v[:-1]), atol=0.01)
    np.testing.assert_allclose(np.diff(pose[:, 2]) / 0.02, 0.5 * (turn[1:] + turn[:-1]), atol=0.06)


def test_where_the_route_turns_back_it_turns_no_faster_than_it_can() -> None:
    """Corners of 170 deg rounded over a metre are turns on the spot, half a turn within centimetres."""
    drive = Drive(Route(((0.0, 0.0), (5.0, 0.0), (1.3, 0.1), (2.3, 3.0), (0.0, 4.0)), 1.2), BODY)
    t = np.arange(0.0, drive.lap_s, 0.02)
    assert np.abs(np.diff(drive.pose(t)[:, 2])).max() / 0.02 < 1.7 * BODY.turn_rate


def test_robot_drives_forward_never_sideways() -> None:
    drive = Drive(SQUARE, BODY)
    pose = drive.pose(np.arange(0.0, drive.lap_s, 0.01))
    step = np.diff(pose[:, :2], axis=0)
    middle = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    sideways = -np.sin(middle) * step[:, 0] + np.cos(middle) * step[:, 1]
    assert np.abs(sideways).max() < 5e-5


def test_laps_continue_without_a_jump_and_then_stop() -> None:
    drive = Drive(SQUARE, BODY, dwell_s=1.5, laps=2)
    t = np.arange(-1.0, 2.5 * drive.lap_s, 0.01)
    pose = drive.pose(t)
    assert np.hypot(*np.diff(pose[:, :2], axis=0).T).max() < BODY.speed * 0.0101
    assert np.abs(np.diff(pose[:, 2])).max() < BODY.turn_rate * 0.0105
    assert drive.travelled(t)[-1] == pytest.approx(2 * drive.length_m)
    still = drive.twist(np.array([-0.5, 0.5, drive.lap_s + 1.0, 2.2 * drive.lap_s]))
    np.testing.assert_array_equal(still, 0.0)


def test_scan_plane_is_level_but_for_the_mount_while_standing() -> None:
    drive = Drive(SQUARE, BODY)
    assert drive.tilt(0.5) == pytest.approx((BODY.tilt, 0.0), abs=1e-9)
    moving = np.array([drive.tilt(float(t)) for t in np.linspace(10, 15, 200)])
    assert 0.2 * BODY.sway < moving[:, 1].std() < BODY.sway


def plan_of(polished: bool) -> Plan:
    plan = Plan()
    plan.outline([(-2, -2), (12, -2), (12, 12), (-2, 12)])
    if polished:
        plan.polish(-2, -2, 12, 12)
    return plan


def odometer(wheels: Wheels, seed: int = 0, polished: bool = False) -> tuple[Drive, Odometer]:
    drive = Drive(SQUARE, BODY)
    return drive, Odometer(drive, plan_of(polished).build(), wheels, seed)


def run(wheels: Wheels, seconds: float, seed: int = 0, polished: bool = False) -> tuple[Array, Array]:
    """Readings, and the truth relative to the start."""
    drive, wheel = odometer(wheels, seed, polished)
    count = int(seconds * wheels.rate_hz)
    readings = np.array([wheel.reading(k) for k in range(count)])
    truth = drive.pose(np.arange(count) / wheels.rate_hz)
    c, s = np.cos(truth[0, 2]), np.sin(truth[0, 2])
    ahead = truth[:, :2] - truth[0, :2]
    local = np.column_stack([c * ahead[:, 0] + s * ahead[:, 1], -s * ahead[:, 0] + c * ahead[:, 1]])
    return readings, np.column_stack([local, truth[:, 2] - truth[0, 2]])


def test_perfect_wheels_follow_the_truth() -> None:
    readings, truth = run(PERFECT, 80.0)
    np.testing.assert_allclose(readings, truth, atol=2e-3)


def test_standing_still_moves_no_wheel() -> None:
    readings, _ = run(Wheels(), 1.9)
    np.testing.assert_array_equal(readings, 0.0)


def test_wheel_noise_grows_with_the_root_of_distance() -> None:
    """After s metres each wheel's travel is off by noise * sqrt(s): half that, squared twice, for their mean."""
    wheels = replace(PERFECT, noise=0.01)
    errors = []
    for seed in range(60):
        readings, truth = run(wheels, 12.0, seed)  # still on the first straight stretch
        errors.append(readings[-1, 0] - truth[-1, 0])
    distance = truth[-1, 0]
    assert np.std(errors) == pytest.approx(0.01 * np.sqrt(distance / 2), rel=0.3)


def test_unequal_radii_bend_the_path() -> None:
    drive, wheel = odometer(replace(PERFECT, scale=0.01), seed=4)
    k = int(14.0 * 50)
    want = (wheel.scale[1] - wheel.scale[0]) * drive.travelled(np.array([14.0]))[0] / BODY.wheel_base
    assert wheel.reading(k)[2] == pytest.approx(want, rel=1e-3)
    assert abs(want) > 0.01


def test_wheels_slip_more_on_a_polished_floor() -> None:
    wheels = replace(PERFECT, slips_per_m=0.5, slip_m=0.02)

    def spread(polished: bool) -> float:
        ends = [run(wheels, 12.0, seed, polished) for seed in range(40)]
        return float(np.mean([abs(r[-1, 2] - t[-1, 2]) for r, t in ends]))

    matt, slick = spread(False), spread(True)
    assert slick > 1.5 * matt > 0.0


def test_slip_comes_as_often_as_ordered() -> None:
    wheels = replace(PERFECT, slips_per_m=0.4, slip_m=0.02)
    events, driven = 0, 0.0
    for seed in range(20):
        readings, truth = run(wheels, 14.0, seed)
        turned = np.abs(np.diff(readings[:, 2] - truth[:, 2]))
        events += int(np.count_nonzero(turned > 1e-3))  # a slip of 0.4 mm or more
        driven += truth[-1, 0]
    assert events / driven == pytest.approx(0.4, rel=0.3)


def test_same_seed_same_slip() -> None:
    a, b, c = run(Wheels(), 30.0, 1)[0], run(Wheels(), 30.0, 1)[0], run(Wheels(), 30.0, 2)[0]
    np.testing.assert_array_equal(a, b)
    assert np.any(a != c)


def test_odometry_of_a_lap_is_off_as_a_cheap_base_is() -> None:
    """Between 0.1 % and 15 % of the distance at the end of a lap, over seeds."""
    off = []
    for seed in range(8):
        readings, truth = run(Wheels(), 80.0, seed)
        off.append(np.hypot(*(readings[-1, :2] - truth[-1, :2])) / 35.0)
    assert 0.001 < np.median(off) < 0.15


def test_readings_are_made_in_order() -> None:
    _, wheel = odometer(Wheels())
    wheel.reading(2000)
    with pytest.raises(ValueError, match="made in order"):
        wheel.reading(3)
