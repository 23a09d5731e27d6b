"""A robot that is lifted and put down elsewhere: the truth jumps, its wheels do not."""

from __future__ import annotations

import numpy as np
import pytest

from hal.fake.faults.orders import FaultError, read_fault
from hal.fake.lidar.models import UTM_30LX
from tools.sim.robot.drive import Body, Drive, Route
from tools.sim.robot.hands import VOCABULARY, Hands, Way, start_of, then
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


def test_frames_are_put_in_a_row_and_taken_apart() -> None:
    frame, pose = np.array((1.0, 2.0, 0.7)), np.array((0.3, -0.4, 4.0))
    assert start_of(then(frame, pose), pose) == pytest.approx(frame)


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


def test_an_order_for_the_robot_needs_no_address() -> None:
    scene = SimulatedScene(Scenario(people=False))
    scene.begin(0.0)
    words = {"robot": VOCABULARY, "lidar": {}}
    fault = read_fault({"what": "carry", "ahead": 30}, "order", words)
    hands = Hands(scene, lambda: 5.0)
    hands.begin(fault)
    assert float(scene.driven(np.array([8.0]))[0]) == pytest.approx(36.0)
    assert hands.in_force() == []
    with pytest.raises(FaultError, match=r"order\.ahead"):
        read_fault({"what": "carry", "ahead": -1.0}, "order", words)


def test_a_robot_that_has_not_driven_off_is_not_carried() -> None:
    scene = SimulatedScene(Scenario(people=False, lidar="UTM-30LX"), held=True)
    scene.begin(0.0)
    scene.carry(1.0, 30.0, 1.0)
    assert scene.truth(np.array([5.0]))[0] == pytest.approx(scene.truth(np.array([0.0]))[0])
    assert scene.model is UTM_30LX
