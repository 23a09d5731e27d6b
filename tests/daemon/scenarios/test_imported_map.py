"""A drawing of a room, imported, moved by two points, a daemon started in it: pose and map ID as they go out."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from daemon.app import Daemon, Environment
from daemon.cli import parser
from daemon.config.schema import Config, LidarConfig, MapConfig, ModbusConfig
from daemon.maps.initial_state import started
from daemon.runtime.budget import FixedBudget
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from daemon.system import console
from estimator.numerics import se2
from hal.clock import LoopClock, run_virtual
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import URG_04LX_UG01
from hal.fake.lidar.scan_world import COLUMN, ROOM, Room
from hal.fake.transport.memory_host import FakeOpener

pytestmark = pytest.mark.jit
DEVICE = "/dev/ttyACM0"
CELL = 0.05
LOW = np.array((-0.513, -0.521))
MOVED = np.array((20.0, 10.0, 0.5 * np.pi))


def draw(folder: Path) -> Path:
    """An architect's drawing of the fake sensor's room, as map_server keeps it."""
    shades = np.full((124, 162), 254, np.uint8)
    for outline in (ROOM, COLUMN):
        for a, b in zip(outline, outline[1:] + outline[:1], strict=True):
            column, row = np.floor((np.linspace(a, b, 1000) - LOW) / CELL).astype(int).T
            shades[row, column] = 0
    Image.fromarray(shades[::-1]).save(folder / "room.png")
    (folder / "room.yaml").write_text(
        f"image: room.png\nresolution: {CELL}\norigin: [{LOW[0]}, {LOW[1]}, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return folder / "room.yaml"


def published(config: MapConfig, seconds: float) -> tuple[list[Snapshot], Room]:
    """What a daemon with these maps publishes, and where its sensor was."""
    room = Room(URG_04LX_UG01)
    snapshots: list[Snapshot] = []

    async def go() -> None:
        clock = LoopClock(asyncio.get_running_loop(), utc_at_zero=1.7e9)
        opener = FakeOpener(clock)
        opener.plug(DEVICE, FakeHokuyo(URG_04LX_UG01, room))
        settings = Config(lidar=LidarConfig(device=DEVICE), modbus=ModbusConfig(port=0), map=config)
        store, start = started(config, None)
        world = Environment(
            clock,
            opener=opener,
            make_worker=CycleWorker,
            make_budget=FixedBudget,
            warm_up=warm,
            sinks=(snapshots.append,),
            store=store,
            start=start,
        )
        stop = asyncio.Event()
        running = asyncio.create_task(Daemon(settings, world).run(stop))
        await asyncio.sleep(seconds)
        stop.set()
        await asyncio.wait_for(running, 10.0)

    run_virtual(go())
    return snapshots, room


async def warm() -> None:
    """The estimator is loaded already."""


def test_a_robot_in_an_imported_and_moved_map_is_where_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps = tmp_path / "maps"
    assert parser.main(["map", "import", str(draw(tmp_path)), "--set", f"map.folder={maps}"]) == console.OK
    (first,) = maps.glob("*.lumimap")
    points = se2.apply(MOVED, np.array([(0.0, 0.0), (7.0, 3.5)]))
    words = [f"--point=0,0={points[0, 0]},{points[0, 1]}", f"--point=7,3.5={points[1, 0]},{points[1, 1]}"]
    assert parser.main(["map", "align", str(first), *words]) == console.OK
    map_id = int(capsys.readouterr().out.split()[-1], 16)
    snapshots, room = published(MapConfig(folder=str(maps), localise=True), 30.0)
    posed = [one for one in snapshots if one.pose is not None]
    assert {one.map_id for one in posed} == {map_id}
    known = [one for one in posed if one.state is State.TRACKING]
    assert len(known) > 100
    truth = room.pose(np.array([one.t_mono for one in known]))
    off = np.array(
        [se2.between(se2.compose(MOVED, T), np.array(one.pose)) for T, one in zip(truth, known, strict=True)]
    )
    assert np.hypot(*off[:, :2].T).max() < 0.06
    assert np.degrees(np.abs(off[:, 2])).max() < 1.0
    assert len(list(maps.glob("*.lumimap"))) == 2  # used as they are
