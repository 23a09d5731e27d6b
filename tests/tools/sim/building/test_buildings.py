"""The buildings are what they are said to be, and their tours can be driven."""

from __future__ import annotations

import time

import numpy as np
import pytest

from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.building.buildings import BUILDINGS, building, corridor_loop
from tools.sim.building.office import DOOR, office_floor
from tools.sim.building.people import KEEP_AWAY_M, Crowd, Walker
from tools.sim.building.world import CIRCLE, MATERIAL_ID, Array, Plan
from tools.sim.robot.drive import Body, Drive


@pytest.mark.parametrize("name", sorted(BUILDINGS))
def test_tour_keeps_clear_of_everything(name: str) -> None:
    place = building(name)
    drive = Drive(place.route, Body())
    track = drive.pose(np.arange(0.0, drive.lap_s, 0.1))[:, :2]
    assert place.world.clearance(track).min() > 0.35


@pytest.mark.parametrize("name", sorted(BUILDINGS))
def test_tour_starts_on_a_straight(name: str) -> None:
    """So that the start pose is the first corner itself, along the first leg."""
    route = building(name).route
    start = Drive(route, Body()).pose(np.zeros(1))[0]
    (x0, y0), (x1, y1) = route.corners[:2]
    np.testing.assert_allclose(start, (x0, y0, np.arctan2(y1 - y0, x1 - x0)), atol=1e-6)


def test_unknown_building_names_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"'attic'.*corridor_loop, office_floor, paper_room, warehouse_hall"):
        building("attic")


def test_empty_plan_is_refused() -> None:
    with pytest.raises(ValueError, match="draw at least one"):
        Plan().build()


def inside_room(shapes: Array) -> Array:
    """The rows of the paper's room itself, without corridor and outside."""
    ends = np.where((shapes[:, 0] == CIRCLE)[:, None], shapes[:, [1, 2, 1, 2]], shapes[:, 1:5])
    return np.asarray(shapes[np.all(np.abs(ends) <= 5.001, axis=1)])


def test_paper_room_is_10_m_square_and_axisymmetric_with_four_columns() -> None:
    rows = inside_room(building("paper_room").world.shapes)
    columns = rows[rows[:, 0] == CIRCLE]
    assert len(columns) == 4
    assert len(np.unique(columns[:, 3])) == 1
    mirrored = columns.copy()
    mirrored[:, 2] *= -1
    assert {tuple(row) for row in mirrored} == {tuple(row) for row in columns}
    glass = rows[rows[:, 5] == MATERIAL_ID["glass"]]
    assert np.all(glass[:, [1, 3]] == 5.0)
    assert np.abs(glass[:, 4] - glass[:, 2]).sum() > 4.0
    lines = rows[rows[:, 0] != CIRCLE]
    flipped = lines[:, [0, 1, 4, 3, 2, 5]] * np.array([1, 1, -1, 1, -1, 1])
    for row in flipped:  # a line mirrored in the x axis is a line of the room again, either way round
        same = np.abs(lines - row).max(axis=1) < 1e-6
        reverse = np.abs(lines[:, [0, 3, 4, 1, 2, 5]] - row).max(axis=1) < 1e-6
        assert np.any(same | reverse), row


def test_paper_corridor_is_long_and_polished() -> None:
    floors = building("paper_room").world.polished
    assert len(floors) == 1
    x_min, y_min, x_max, y_max = floors[0]
    assert y_max - y_min > 60.0
    assert x_max - x_min == pytest.approx(2.0)


def test_corridor_loop_says_nothing_along_its_walls() -> None:
    """Two places 1 m apart in the middle of a plain stretch see the same, but for the far ends."""
    place = corridor_loop(60.0, 25.0)
    near = Sweep(np.radians(np.concatenate([np.arange(30, 150), np.arange(-150, -30)])), 0.0, 0.01)
    scanner = Scanner(place.world, near, UTM_30LX, 1)
    seen = [
        scanner.measure(0.0, lambda t, x=x: np.tile([x, 1.1, 0.0], (len(t), 1)), np.zeros((0, 7)), Posture())
        for x in (29.0, 30.0)
    ]
    np.testing.assert_allclose(seen[0].range_m, seen[1].range_m, atol=1e-9)


def doors(shapes: Array) -> int:
    length = np.hypot(shapes[:, 3] - shapes[:, 1], shapes[:, 4] - shapes[:, 2])
    return int(np.count_nonzero((shapes[:, 5] == MATERIAL_ID["wood"]) & (np.abs(length - DOOR) < 1e-6)))


def test_office_has_sixty_rooms_each_with_a_door() -> None:
    assert doors(building("office_floor").world.shapes) == 60


def test_office_doors_open_into_the_room_through_a_gap() -> None:
    """From the corridor's middle, right before an open door, the lidar sees past the corridor wall."""
    place = building("office_floor")
    shapes = place.world.shapes
    length = np.hypot(shapes[:, 3] - shapes[:, 1], shapes[:, 4] - shapes[:, 2])
    wide = shapes[(np.abs(length - DOOR) < 1e-6) & (np.abs(shapes[:, 3] - shapes[:, 1]) < 0.05)]
    assert len(wide) > 8
    ahead = Sweep(np.zeros(1), 0.0, 0.0)
    scanner = Scanner(place.world, ahead, UTM_30LX)
    deep = 0
    for _, x, y, _, y_leaf, _ in wide:
        yaw = np.copysign(np.pi / 2, y_leaf - y)
        pose = np.array([x + 0.5 * DOOR, y - np.sign(yaw) * 1.0, yaw])
        seen = scanner.measure(0.0, lambda t, pose=pose: np.tile(pose, (len(t), 1)), np.zeros((0, 7)), Posture())
        deep += seen.range_m[0, 0] > 1.5
    assert deep >= 0.9 * len(wide)


def test_offices_of_different_seeds_differ_and_of_one_seed_do_not() -> None:
    a, b, c = office_floor(1).world.shapes, office_floor(1).world.shapes, office_floor(2).world.shapes
    np.testing.assert_array_equal(a, b)
    assert a.shape != c.shape or np.any(a != c)


def test_people_walk_at_their_speed_on_two_legs() -> None:
    crowd = Crowd((Walker(((0.0, 0.0), (20.0, 0.0)), speed=1.2),))
    far = np.array([100.0, 100.0, 0.0])
    t = np.arange(0.0, 10.0, 0.05)
    legs = np.array([crowd.legs(float(time_), far) for time_ in t])
    middle = legs[:, :, 1].mean(axis=1)
    np.testing.assert_allclose(middle, 1.2 * t, atol=1e-9)
    apart = legs[:, 0, 1] - legs[:, 1, 1]
    assert 0.4 < np.abs(apart).max() < 0.7
    speed = (legs[1:, 0, 1] - legs[:-1, 0, 1]) / 0.05
    np.testing.assert_allclose(speed, 0.5 * (legs[1:, 0, 5] + legs[:-1, 0, 5]), atol=0.1)


def test_people_turn_round_at_the_end() -> None:
    crowd = Crowd((Walker(((0.0, 0.0), (6.0, 0.0)), speed=1.0),))
    far = np.array([100.0, 100.0, 0.0])
    x = [crowd.legs(t, far)[:, 1].mean() for t in (5.0, 7.0, 13.0)]
    np.testing.assert_allclose(x, [5.0, 5.0, 1.0], atol=1e-9)


def test_people_step_aside_for_the_robot() -> None:
    crowd = Crowd((Walker(((0.0, 0.0), (20.0, 0.0)), speed=1.0),))
    robot = np.array([5.0, 0.1, 0.0])
    middles = np.array([crowd.legs(float(t), robot)[:, 1:3].mean(axis=0) for t in np.arange(3.0, 7.0, 0.02)])
    assert np.hypot(*(middles - robot[:2]).T).min() >= KEEP_AWAY_M - 1e-9


@pytest.mark.realtime
def test_an_office_scan_costs_at_most_a_fraction_of_its_period() -> None:
    """2 ms are meant for 1081 beams; judged with fourfold slack because the machine is shared."""
    place = building("office_floor")
    drive, crowd = Drive(place.route, Body()), Crowd(place.people)
    scanner = Scanner(place.world, Sweep(np.radians(np.arange(-540, 541) * 0.25), 0.0, 0.019), UTM_30LX)
    spent = []
    for t in np.linspace(0.0, drive.lap_s, 60):
        begin = time.thread_time()
        pose = drive.pose(np.array([t]))[0]
        scanner.measure(float(t), drive.pose, crowd.legs(float(t), pose), Posture(0.3, *drive.tilt(float(t))))
        spent.append(time.thread_time() - begin)
    assert np.median(spent) < 8e-3
