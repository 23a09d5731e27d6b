"""The fake lidar on a pseudo-terminal, in real time."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from hal.errors import DeviceRefused
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import URG_04LX
from hal.fake.transport.pty_server import PtyServer
from tests.hal.fake.bench import read
from tests.hal.fake.real_time import gather, on_pty, opened, quiet, until

MD = b"MD0000108000000\n"

pytestmark = pytest.mark.realtime


def test_pty_streams_what_the_world_says(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path) as port:
            port.write(b"VV\n" + MD)
            vv, ack, *scans = await gather(port, 22)
            assert read(vv).pairs["SERI"] == device.unit.serial
            assert read(ack).status == "00"
            for n, scan in enumerate(scans):
                assert read(scan).values() == [1000 + step + 2 * n for step in range(1081)]
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


def test_pty_whose_host_does_not_read_loses_whole_scans(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path) as port:
            port.write(MD)
            await until(lambda: device.counts.refused_by_host > 10)
            scans = [read(data) for data in (await gather(port, 12))[1:]]
            gaps = np.diff([scan.values()[0] for scan in scans]) // 2
            assert gaps[0] == 1
            assert gaps.max() > 10
            assert device.counts.sent > 8

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


def test_pty_knows_the_rate_of_the_host(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path, 57600) as port:
            await until(lambda: device.attached)
            port.write(b"VV\n")
            await quiet(port)
            assert device.counts.sent == 0
            port.baudrate = 19200
            port.write(b"SS250000\n")
            assert await gather(port, 1) == [b"SS250000\n00P\n\n"]
            await until(lambda: device.baud == 250000)
            port.baudrate = 250000
            port.write(b"VV\n")
            assert (await gather(port, 1))[0].startswith(b"VV\n00P\n")

    on_pty(scene, tmp_path / "lidar", URG_04LX)


def test_pty_replaces_a_stale_link_but_nothing_else(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    link.symlink_to("/nonexistent/pts")

    async def scene(_device: FakeHokuyo, server: PtyServer) -> None:
        assert link.resolve().exists()
        assert server.path == str(link)

    on_pty(scene, link)
    assert not link.is_symlink()
    link.write_text("precious")
    with pytest.raises(DeviceRefused, match="no symbolic link"):
        on_pty(scene, link)
    assert link.read_text() == "precious"
