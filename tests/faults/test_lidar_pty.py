"""The same over the kernel: the real driver with its real port at a pty, in real time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hal.clock import SystemClock
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import UTM_30LX
from hal.fake.transport.pty_server import PtyServer
from hal.hokuyo.driver import HokuyoDriver
from hal.lidar import VALID, Link, RawScan
from hal.port.opening import open_port
from tests.faults.bench import World

PATIENCE = 4.0


async def until(true: Callable[[], object], seconds: float) -> None:
    deadline = time.monotonic() + seconds * PATIENCE
    while not true():
        assert time.monotonic() < deadline, "waited too long"
        await asyncio.sleep(0.02)


@pytest.mark.realtime
async def test_driver_on_a_pty_survives_a_pulled_plug_and_a_damaged_line(tmp_path: Path) -> None:
    world = World(UTM_30LX)
    device = FakeHokuyo(UTM_30LX, world)
    server = PtyServer(device, tmp_path / "ttyACM0")
    schedule = FaultSchedule({"lidar": device})
    driver = HokuyoDriver(server.path, clock=SystemClock(), opener=open_port)
    scans: list[RawScan] = []
    task = asyncio.create_task(driver.run(scans.append))

    async def more(count: int, seconds: float) -> None:
        wanted = len(scans) + count
        await until(lambda: len(scans) >= wanted, seconds)

    await more(20, 2.0)
    schedule.load("[[fault]]\nwhat = 'bit_flip'\nevery = 2\ncount = 10")
    await until(lambda: driver.status.invalid >= 10, 2.0)
    await more(20, 1.0)
    schedule.load("[[fault]]\nwhat = 'hangup'\nfor = 0.3")
    await until(lambda: driver.status.link is Link.WAITING, 1.0)
    await more(20, 3.0)
    assert driver.status.reconnects == 1
    assert (driver.status.link, driver.status.error) == (Link.STREAMING, None)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await until(lambda: not device.laser, 1.0)
    schedule.close()
    server.close()
    device.close()
    numbers = [world.number(scan) for scan in scans]
    assert None not in numbers
    assert numbers == sorted(set(numbers), key=int)  # type: ignore[arg-type]  # None was ruled out
    assert all(np.all(scan.code == VALID) for scan in scans)
