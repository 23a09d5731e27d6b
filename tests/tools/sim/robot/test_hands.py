"""A robot that is lifted and put down elsewhere: the truth jumps, its wheels do not."""

import numpy as np
import pytest

from tools.sim.robot.drive import Body, Drive, Route
from tools.sim.robot.hands import Way
from tools.sim.robot.odometry import Wheels
from tools.sim.scene import Scenario, SimulatedScene

SQUARE = Route(((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)))


def test_the_drive_stands_still_in_the_air_and_goes_on_further_along() -> None:
    drive = Drive(SQUARE, Body())
    way = Way(drive)
    way.carry(10.0, ahead_s=8.0, takes_s=2.0)
    way.carry(11.0, ahead_s=8.0, takes_s=2.0)  # nobody can take what somebody holds
    assert way.clock(np.array([-1.0, 9.0, 11.0, 12.0, 13.0])) == pytest.approx([0.0, 9.0, 10.0, 18.0, 19.0])
    begin, end = drive.pose(np.array([10.0, 18.0]))
    there = way.poses(np.array([9.999999, 11.0, 12.0]))
    assert there[0] == pytest.approx(begin, abs=1e-4)
    assert there[1, :2] == pytest.approx(0.5 * (begin + end)[:2])
    assert there[2] == pytest.approx(end)


def test_wheels_count_nothing_of_being_carried() -> None:
    exact = Wheels(scale=0.0, base_scale=0.0, noise=0.0, slips_per_m=0.0)
    scene = SimulatedScene(Scenario(wheels=exact, people=False))
    scene.begin(100.0)
    before = scene.truth(np.array([110.0]))[0]
    scene.carry(110.0, 40.0, 2.0)
    readings = {}
    t = 109.0
    while t < 115.0:
        reading = scene.odometry_after(t)
        assert reading is not None
        t, readings[round(t - 100.0, 2)] = reading
    lifted, down, later = scene.truth(np.array([111.0, 112.0, 114.0]))
    assert np.hypot(*(down - before)[:2]) > 1.0
    assert np.hypot(*(lifted - before)[:2]) > 0.4
    assert readings[12.0] == pytest.approx(readings[10.0], abs=1e-3)
    moved = np.hypot(*(later - down)[:2])
    assert moved > 0.5
    assert np.hypot(*(readings[14.0] - readings[12.0])[:2]) == pytest.approx(moved, abs=5e-3)
