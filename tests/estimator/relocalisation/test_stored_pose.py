"""Switched on where it was switched off, a robot is found without driving; one that was moved is not believed."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.mapping.keyframe import Settled
from estimator.measurements import Array, Command, Order
from estimator.numerics import se2
from tests.estimator.adrift import Robot, furnished, mapped, rooms, stored, way
from tools.bench.support.scenes import Scene, box

pytestmark = pytest.mark.jit

TOUR = (
    *((1.0, 6.0), (10.8, 6.0), (1.0, 6.0), (1.85, 6.0), (1.85, 1.5), (1.85, 6.0)),
    *((5.85, 6.0), (5.85, 1.5), (5.85, 6.0), (9.05, 6.0), (9.05, 1.5)),
)
HERE = np.array((1.85, 1.6, -1.4))
Floor = tuple[Scene, list[tuple[Array, Settled]]]


@pytest.fixture(scope="module")
def floor() -> Floor:
    scene = furnished()
    return scene, mapped(scene, TOUR)


def stand(floor: Floor, T: Array, remembered: Array, scans: int = 12) -> tuple[Robot, list[int | None]]:
    """A robot that is switched on at a place and stands; how many places fit, scan by scan."""
    robot = Robot(stored(floor[1]), floor[0])
    said = [robot.at(T, Command(robot.t, Order.REMEMBERED, remembered)).places]
    return robot, said + [robot.at(T).places for _ in range(scans - 1)]


def test_a_robot_that_was_not_moved_is_found_where_it_stands(floor: Floor) -> None:
    robot, said = stand(floor, HERE, HERE + np.array((0.05, -0.05, 0.03)))
    assert said[0] == 0
    assert said[-1] is None
    assert said.index(None) <= 2 * robot.late
    assert robot.off()[0] < 0.05
    assert robot.off()[1] < np.radians(1.0)
    watch = robot.state.map.parts.trial
    assert watch is not None
    assert watch.alone, "the laser alone has decided: nothing is stored of it before it has proved itself"


def test_without_a_memory_a_robot_that_stands_stays_adrift(floor: Floor) -> None:
    robot = Robot(stored(floor[1]), floor[0])
    assert [robot.at(HERE).places for _ in range(12)][-1] == 1


@pytest.mark.parametrize("moved", [(7.2, 0.0, 0.0), (0.0, 4.3, 0.5), (0.0, -1.1, 0.0), (0.0, 0.0, 2.0)])
def test_a_robot_that_was_moved_is_not_where_it_was(floor: Floor, moved: tuple[float, float, float]) -> None:
    robot, said = stand(floor, HERE, HERE + np.array(moved), 20)
    assert None not in said, "not found yet, and not called found: it has to drive"
    robot.along(way(((1.85, 1.6), (1.85, 6.0), (4.0, 6.0)), 0.06))
    assert robot.state.map.parts.detached is None
    assert robot.state.relocalisation.search.terrain is None, "what it was looked for in: the whole map a second time"
    assert robot.off()[0] < 0.1


def test_of_two_places_that_fit_the_remembered_one_may_be_the_wrong_one() -> None:
    scene = Scene(np.array(box(-3.0, -2.0, 3.0, 2.0), dtype=np.float64), (-2.5, -1.5), (2.5, 1.5))
    about = (-1.5, -1.0), (1.5, -1.0), (1.5, 1.0), (-1.5, 1.0), (-1.5, -1.0)
    here = np.array((-1.5, -1.0, 0.3))
    for turned in (here, np.array((1.5, 1.0, 0.3 - np.pi))):  # either way it looks the same
        _, said = stand((scene, mapped(scene, about)), turned, here, 20)
        assert None not in said


def test_a_room_that_is_nearly_its_own_image_is_told_by_the_little_that_is_not() -> None:
    """With one cupboard in it: found where it was left, and where it was turned about it is not taken for that."""
    walls = [*box(-3.0, -2.0, 3.0, 2.0), *box(1.4, 0.7, 1.9, 1.2)]
    scene = Scene(np.array(walls, dtype=np.float64), (-2.5, -1.5), (2.5, 1.5))
    about = (-1.5, -1.0), (1.5, -1.0), (1.5, 0.4), (-1.5, 1.0), (-1.5, -1.0)
    floor, here, turned = (scene, mapped(scene, about)), np.array((-0.7, 0.4, 0.0)), np.array((0.7, -0.4, np.pi))
    robot, said = stand(floor, here, here)
    assert said[-1] is None
    assert robot.off()[0] < 0.05
    _, said = stand(floor, turned, here, 20)
    assert None not in said


def test_moved_to_a_room_that_looks_the_same_it_is_nowhere_sure() -> None:
    scene = rooms((4.0, 4.0, 4.0))
    floor = (
        scene,
        mapped(scene, ((1.0, 6.0), (10.8, 6.0), (1.85, 6.0), (1.85, 1.5), (1.85, 6.0), (5.85, 6.0), (5.85, 1.5))),
    )
    robot, said = stand(floor, np.array((5.85, 1.6, -1.4)), np.array((1.85, 1.6, -1.4)), 20)
    assert None not in said or robot.off()[0] < 0.1


def test_a_person_knows_better_and_a_pose_that_is_none_says_nothing(floor: Floor) -> None:
    robot = Robot(stored(floor[1]), floor[0])
    there = np.array((9.05, 2.0, -1.4))
    robot.at(HERE, Command(robot.t, Order.SET_POSE, HERE), Command(robot.t + 0.01, Order.REMEMBERED, there))
    assert robot.state.relocalisation.search.remembered is None
    for pose in (None, np.array((np.nan, 0.0, 0.0))):
        robot = Robot(stored(floor[1]), floor[0])
        before = robot.state.pose.T_map_odom.copy()
        robot.at(HERE, Command(robot.t, Order.REMEMBERED, pose))
        assert robot.state.relocalisation.search.remembered is None
        np.testing.assert_array_equal(se2.between(before, robot.state.pose.T_map_odom), np.zeros(3))


def test_who_is_carried_off_after_the_start_is_not_held_by_an_old_memory(floor: Floor) -> None:
    robot, _ = stand(floor, HERE, HERE, 4)
    robot.at(HERE, Command(robot.t, Order.RELOCALISE))
    assert robot.state.relocalisation.search.remembered is None


def trial(seed: int) -> tuple[str, bool, float]:
    """One building, one start: how the robot was treated, whether it was found, how far off it was told then."""
    rng = np.random.default_rng(seed)
    widths = rng.uniform(3.0, 5.0, 3) if seed % 2 else np.full(3, 4.0)
    scene = furnished(widths, seed) if seed % 3 else rooms(widths)
    doors = np.concatenate(([0.0], np.cumsum(widths)[:-1])) + 1.85
    inside = [corner for x in doors for corner in ((x, 6.0), (x, 2.6), (x, 6.0))]
    floor = scene, mapped(scene, ((1.0, 6.0), *inside, (sum(widths) - 1.2, 6.0)), seed)
    room, into = int(rng.integers(3)), np.array((*rng.uniform(-0.3, 0.3, 2), rng.uniform(-np.pi, np.pi)))
    here = np.array((doors[room], rng.choice([6.0, 3.0]), 0.0)) + into
    how = ("left", "another room", "turned", "pushed")[seed // 6 % 4]
    left = here.copy()
    if how == "another room":
        left[0] = doors[(room + 1) % 3] + into[0]
    elif how == "turned":
        left[2] += rng.choice([np.pi, np.pi / 2])
    elif how == "pushed":
        left[:2] += rng.uniform(0.4, 0.9) * np.array((np.cos(into[2]), np.sin(into[2])))
    robot, said = stand(floor, here, left, 16)
    return how, None in said, robot.off()[0]


@pytest.mark.slow
def test_whatever_the_building_nobody_is_believed_where_it_is_not() -> None:
    tried = [trial(seed) for seed in range(48)]
    assert all(off < 0.1 for _, found, off in tried if found)
    left = [found for how, found, _ in tried if how == "left"]
    assert sum(left) >= 0.7 * len(left)
