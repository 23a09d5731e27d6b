"""Light and laser in one step: where the map lies, who holds which axis, and what happens when one of them is gone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from estimator.records import Record
from tests.estimator.lit import Log, lit_state, play, scans, together
from tools.sim.buildings import building
from tools.sim.ceiling import ceiling_of
from tools.sim.ceiling_links import Reception
from tools.sim.ceiling_records import survey
from tools.sim.lightrun import LightRun, room_run
from tools.sim.odometry import Wheels
from tools.sim.robot import Body, Drive, Route

pytestmark = pytest.mark.jit


def room(seed: int, seconds: float) -> LightRun:
    return replace(room_run(seed=seed, people=0), seconds=seconds)


def corridor(seconds: float) -> LightRun:
    """Along the paper's corridor, whose lamps are 2.7 m apart."""
    place = building("paper_room")
    drive = Drive(Route(((-6.15, -3.0), (-6.15, 47.0)), 1.2), Body(), 0.0, 1)
    ceiling = ceiling_of(place, None, 4)
    return LightRun(drive, ceiling, survey(ceiling), Wheels(), place.world, 4, seconds, Reception())


def without(records: Iterator[Record], kind: type, begin: float, end: float) -> Iterator[Record]:
    return (r for r in records if not (isinstance(r, kind) and begin <= r.t_end < end))


def everything(run: LightRun) -> Iterator[Record]:
    return together(run.odometry(), run.light(), scans(run))


def smoothest(log: Log) -> float:
    """The longest step of T_odom_base between two results, m."""
    poses = np.array([r.T_odom_base for r in log.results])
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).max())


@pytest.fixture(scope="module")
def in_room() -> Log:
    run = room(1, 60.0)
    return play(lit_state(run), everything(run), run.truth)


def test_light_places_the_map_in_the_survey_and_the_laser_steadies_it(in_room: Log) -> None:
    before = [r for r in in_room.results if not r.placed]
    assert 0 < len(before) < 20
    assert all(np.array_equal(r.T_map_odom, np.zeros(3)) for r in before)
    metres, radians = in_room.rmse(30.0)
    assert metres < 0.08
    assert radians < np.radians(1.0)
    assert in_room.nees(30.0) < 9.0


def test_heading_is_unknown_until_the_robot_has_driven(in_room: Log) -> None:
    placed = next(r for r in in_room.results if r.placed)
    assert placed.covariance[2, 2] > 1.0
    assert placed.known_axes.tolist() == [0.0, 0.0, 0.0]
    assert in_room.results[-1].known_axes.tolist() == [1.0, 1.0, 1.0]


def test_what_light_corrects_never_shows_in_the_odometry_frame(in_room: Log) -> None:
    assert in_room.results[-1].jumps > 0
    assert smoothest(in_room) < 0.1
