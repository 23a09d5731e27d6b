"""Every example configuration starts: the whole daemon on the fake sensor, with sockets of its own, to a pose."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path

import numpy as np
import pytest

from daemon.app import Daemon, Environment
from daemon.config import loader
from daemon.config.schema import Config
from daemon.publish.modbus.client import Reader
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from hal.clock import LoopClock, run_virtual
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import UST_10LX, Unit
from hal.fake.lidar.scan_world import Room
from hal.fake.transport.memory_host import FakeOpener
from hal.port.port import Port
from tests.daemon.support.light_room import Lit, plugged
from tools.sim.ports import free_port

EXAMPLES = sorted((Path(__file__).parents[3] / "systemd").glob("*.toml"))


def here(file: Path) -> Config:
    """The example as it is, on this machine's loopback and free ports."""
    settings = loader.load(file)
    changes = ["bind=127.0.0.1", f"modbus.port={free_port()}"]
    if settings.odometry.port:
        changes.append(f"odometry.port={free_port()}")
    return loader.load(file, changes)


async def warm() -> None:
    """The estimator is loaded already."""


async def read_block(port: int) -> dict[str, object]:
    """Read as `lumiloop status` does, from a thread of its own, while virtual time goes on."""
    found: dict[str, object] = {}

    def read() -> None:
        with Reader("127.0.0.1", port) as reader:
            found.update(reader.read())

    reading = threading.Thread(target=read)
    reading.start()
    while reading.is_alive():  # noqa: ASYNC110 - no event of asyncio can be set from a thread
        await asyncio.sleep(0.001)
    return found


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= 3
    assert "lumiloop.toml" in [file.name for file in EXAMPLES]


def test_the_installed_configuration_changes_no_default() -> None:
    installed = next(file for file in EXAMPLES if file.name == "lumiloop.toml")
    assert loader.load(installed) == Config()


@pytest.mark.system
@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_every_example_starts(file: Path) -> None:
    settings = here(file)

    async def go() -> tuple[list[Snapshot], Daemon, dict[str, object]]:
        clock = LoopClock(asyncio.get_running_loop())
        plugs = FakeOpener(clock)
        device = FakeHokuyo(UST_10LX, Room(UST_10LX), unit=Unit(serial=settings.lidar.place.serial or "H0000001"))
        plugs.plug("lidar", device)

        async def open_whatever(name: str, baud: int) -> Port:
            return await plugs("lidar", baud)

        snapshots: list[Snapshot] = []
        buses, adc = plugged(clock, Lit((41, 49, 73, 81)), bus=settings.photodiode.bus)
        adc.add_level(lambda t_mono: np.full_like(t_mono, 0.4))
        world = Environment(
            clock,
            opener=open_whatever,
            make_worker=CycleWorker,
            warm_up=warm,
            sinks=(snapshots.append,),
            buses=buses,
        )
        daemon = Daemon(settings, world)
        stop = asyncio.Event()
        running = asyncio.create_task(daemon.run(stop))
        await asyncio.sleep(5.0)
        block = await read_block(settings.modbus.port)
        assert daemon.supervisor.failed == set()
        stop.set()
        await running
        return snapshots, daemon, block

    # what `auto` finds on the machine the test runs on does not matter: the opener knows one sensor only
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hal.hokuyo.discover.candidates", lambda: ["/dev/ttyACM0"])
        snapshots, daemon, block = run_virtual(go())
    expected = State.DEGRADED if settings.odometry.port else State.TRACKING  # nobody sends odometry here
    if settings.photodiode.fitted:
        assert block["links"] == 4
        assert block["light_fix"] is not None
    else:
        assert snapshots[-1].state is expected
        assert block["state"] == expected
    assert block["map_x"] is not None
    assert daemon.cycle.parts.scans.T_base_lidar[0] == settings.lidar.mount.x
