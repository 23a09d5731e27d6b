"""The drive keeps its limits; errors of the wheels have the stated size."""

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


def test_wheel_noise_grows_with_the_root_of_distance() -> None:
    """After s metres each wheel's travel is off by noise * sqrt(s): half that, squared twice, for their mean."""
    wheels = replace(PERFECT, noise=0.01)
    errors = []
    for seed in range(60):
        readings, truth = run(wheels, 12.0, seed)  # still on the first straight stretch
        errors.append(readings[-1, 0] - truth[-1, 0])
    distance = truth[-1, 0]
    assert np.std(errors) == pytest.approx(0.01 * np.sqrt(distance / 2), rel=0.3)


def test_slip_comes_as_often_as_ordered() -> None:
    wheels = replace(PERFECT, slips_per_m=0.4, slip_m=0.02)
    events, driven = 0, 0.0
    for seed in range(20):
        readings, truth = run(wheels, 14.0, seed)
        turned = np.abs(np.diff(readings[:, 2] - truth[:, 2]))
        events += int(np.count_nonzero(turned > 1e-3))  # a slip of 0.4 mm or more
        driven += truth[-1, 0]
    assert events / driven == pytest.approx(0.4, rel=0.3)
