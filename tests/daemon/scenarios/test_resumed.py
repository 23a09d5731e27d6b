"""The whole daemon, started anew after a kill, in virtual time: where it was left, and where it was carried off to."""

from __future__ import annotations

import asyncio
import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from daemon.config.schema import Config, LidarConfig, MapConfig, ModbusConfig
from daemon.maps.last_pose import FILE, packed, read
from daemon.snapshot import State
from estimator.numerics import se2
from hal.fake.lidar.models import LidarModel
from hal.fake.lidar.scan_world import Room
from tests.daemon.scenarios.test_daemon import DEVICE, Bench, run_daemon

Poses = npt.NDArray[np.float64]
KILLED_S = 40.0
"""By then the robot has seen two thirds of the room."""


@dataclass
class Kept(Bench):
    """A bench whose maps are kept in a folder."""

    folder: Path = field(default_factory=Path)

    def __post_init__(self) -> None:
        self.settings = Config(
            lidar=LidarConfig(device=DEVICE), modbus=ModbusConfig(port=0), map=MapConfig(folder=str(self.folder))
        )
        super().__post_init__()


def standing(at: Poses) -> Callable[[LidarModel], Room]:
    """The room, seen by a robot that stands."""

    class Standing(Room):
        def pose(self, t_mono: Poses) -> Poses:
            return np.broadcast_to(at, (len(t_mono), 3))

    return Standing


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Poses, Poses]:
    """A folder as a kill leaves it; where the robot stood then (room), and where its map begins."""
    folder, left = tmp_path_factory.mktemp("driven"), tmp_path_factory.mktemp("killed") / "maps"
    poses: list[Poses] = []

    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await asyncio.sleep(KILLED_S)
        saved: list[str] = []
        bench.daemon.autosaver.ask(saved.append)
        while not saved:
            await asyncio.sleep(0.05)
            breathe()
        assert saved == [""]
        now = bench.last
        assert now.state is State.TRACKING
        assert now.pose is not None
        shutil.copytree(folder, left)
        told = read(folder / FILE)
        assert told is not None
        assert told.pose is not None
        assert np.hypot(told.pose[0] - now.pose[0], told.pose[1] - now.pose[1]) < 0.15, "five times a second"
        poses.extend(bench.room.pose(np.array([now.t_mono, first.t_mono])))

    run_daemon(scenario, bench=Kept, folder=folder)
    return left, poses[0], poses[1]


def breathe() -> None:
    """A thread writes, in real time."""
    time.sleep(0.002)


def start_anew(killed: tuple[Path, Poses, Poses], folder: Path, at: Poses, seconds: float) -> Kept:
    shutil.copytree(killed[0], folder)

    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(seconds)

    bench = run_daemon(scenario, bench=Kept, folder=folder, world=standing(at))
    assert isinstance(bench, Kept)
    return bench


def wrong(bench: Kept, at: Poses, begin: Poses) -> list[State]:
    """States in which a pose was published that is more than 10 cm or 3 degrees off."""
    true = se2.between(begin, at)
    states = []
    for snapshot in bench.snapshots:
        if snapshot.pose is not None:
            x, y, yaw = se2.between(true, np.array(snapshot.pose)).tolist()
            states += [snapshot.state] if np.hypot(x, y) > 0.1 or abs(yaw) > np.radians(3.0) else []
    return states


def test_where_it_was_left_it_is_tracked_at_once(
    killed: tuple[Path, Poses, Poses], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    _, at, begin = killed
    bench = start_anew(killed, tmp_path / "maps", at, 6.0)
    first = next(s for s in bench.snapshots if s.state is State.RELOCATING)
    tracked = next(s for s in bench.snapshots if s.state is State.TRACKING)
    assert tracked.t_sent - first.t_sent < 2.0
    assert not set(wrong(bench, at, begin)) & {State.TRACKING, State.DEGRADED}
    assert sum("the last stored pose is x" in record.message for record in caplog.records) == 1


MOVED = {
    "a metre and a half": (1.5, 0.2, 0.0),
    "turned about": (0.0, 0.0, np.pi),
    "turned by a right angle": (0.3, 0.0, np.pi / 2),
    "to the other end": (-1.5, -0.6, 0.4),
}


SLOW = [pytest.param(moved, marks=pytest.mark.slow) for moved in list(MOVED)[2:]]


@pytest.mark.parametrize("moved", [*list(MOVED)[:2], *SLOW])
def test_one_that_was_moved_is_never_wrong(killed: tuple[Path, Poses, Poses], tmp_path: Path, moved: str) -> None:
    _, left, begin = killed
    at = left + np.array(MOVED[moved])
    bench = start_anew(killed, tmp_path / "maps", at, 12.0)
    assert not set(wrong(bench, at, begin)) & {State.TRACKING, State.DEGRADED}


def test_a_memory_that_is_wrong_is_no_witness(killed: tuple[Path, Poses, Poses], tmp_path: Path) -> None:
    """The same as a robot that was moved, with the place in the file instead."""
    folder, at, begin = killed
    told = read(folder / FILE)
    assert told is not None
    assert told.pose is not None
    other = tmp_path / "before"
    shutil.copytree(folder, other)
    pose = (told.pose[0] + 1.2, told.pose[1] - 0.7, told.pose[2] + 0.9)
    (other / FILE).write_bytes(packed(type(told)(told.map_id, pose, told.t_utc, told.number)))
    bench = start_anew((other, at, begin), tmp_path / "maps", at, 12.0)
    assert not set(wrong(bench, at, begin)) & {State.TRACKING, State.DEGRADED}
