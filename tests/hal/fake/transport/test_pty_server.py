"""The fake lidar on a pseudo-terminal, in real time."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.transport.pty_server import PtyServer
from tests.hal.fake.bench import read
from tests.hal.fake.real_time import gather, on_pty, opened, until

MD = b"MD0000108000000\n"

pytestmark = pytest.mark.realtime


def test_pty_streams_what_the_world_says(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path) as port:
            port.write(b"VV\n" + MD)
            vv, ack, *scans = await gather(port, 22)
            assert read(vv).pairs["SERI"] == device.unit.serial
            assert read(ack).status == "00"
            last = -2
            for values in (
                read(scan).values() for scan in scans
            ):  # a slow reader misses whole scans, and no part of one
                ahead = values[0] - 1000
                assert ahead > last
                assert ahead % 2 == 0
                assert values == [1000 + step + ahead for step in range(1081)]
                last = ahead
            port.write(b"QT\n")
            await until(lambda: device.state is State.IDLE)

    on_pty(scene, tmp_path / "lidar")


def test_pty_goes_on_when_the_host_leaves_and_nothing_stale_is_left(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path) as port:
            port.write(MD)
            await gather(port, 3)
        await until(lambda: device.counts.without_host > 20)
        assert device.state is State.MULTI
        before = device.scans_sent
        with opened(server.path) as port:
            _, scan, *_ = await gather(port, 3)  # the first may be the rest of one
            assert read(scan).values()[0] >= 1000 + 2 * (before - 1)

    on_pty(scene, tmp_path / "lidar")


def test_pty_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    link = tmp_path / "lidar"

    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        schedule = FaultSchedule({"lidar": device})
        port = opened(server.path)
        port.write(MD)
        await gather(port, 3)
        schedule.load("[[fault]]\nwhat = 'hangup'\nfor = 0.3")
        await until(lambda: not link.is_symlink())

        def hung_up() -> bool:
            try:
                return os.write(port.fd, b"QT\n") < 0
            except OSError as error:
                return error.errno == errno.EIO

        await until(hung_up)
        port.close()
        await until(link.is_symlink)
        with opened(server.path) as again:
            await until(lambda: device.counts.sent)
            await gather(again, 3)
        schedule.close()

    on_pty(scene, link)
