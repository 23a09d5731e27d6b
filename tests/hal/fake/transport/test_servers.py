"""The fake lidar on a pseudo-terminal and on TCP, in real time."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import UST_10LX
from hal.fake.transport.tcp_server import TcpServer
from tests.hal.fake.bench import ramp, read
from tests.hal.fake.real_time import PATIENCE, gather, on_pty, opened, until

MD = b"MD0000108000000\n"

pytestmark = pytest.mark.realtime


async def test_pty_streams_what_the_world_says(tmp_path: Path) -> None:
    async with on_pty(tmp_path / "lidar") as (device, server):
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


async def test_pty_goes_on_when_the_host_leaves_and_nothing_stale_is_left(tmp_path: Path) -> None:
    async with on_pty(tmp_path / "lidar") as (device, server):
        with opened(server.path) as port:
            port.write(MD)
            await gather(port, 3)
        await until(lambda: device.counts.without_host > 20)
        assert device.state is State.MULTI
        before = device.scans_sent
        with opened(server.path) as port:
            _, scan, *_ = await gather(port, 3)  # the first may be the rest of one
            assert read(scan).values()[0] >= 1000 + 2 * (before - 1)


async def test_pty_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    async with on_pty(link) as (device, server):
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


@asynccontextmanager
async def on_tcp() -> AsyncIterator[tuple[FakeHokuyo, TcpServer, int]]:
    device = FakeHokuyo(UST_10LX, ramp(UST_10LX))
    server = TcpServer(device)
    port = await server.listen()
    try:
        yield device, server, port
    finally:
        await server.close()
        device.close()


class Client:
    """A connection to the sensor."""

    def __init__(self, port: int) -> None:
        self.port = port

    async def __aenter__(self) -> Client:
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", self.port)
        return self

    async def __aexit__(self, *_: object) -> None:
        self.writer.close()
        with contextlib.suppress(ConnectionError):
            await self.writer.wait_closed()

    async def reply(self) -> bytes:
        return await asyncio.wait_for(self.reader.readuntil(b"\n\n"), 5 * PATIENCE)

    async def end(self) -> bool:
        """Read until the sensor has hung up."""
        try:
            while await asyncio.wait_for(self.reader.read(100), 5 * PATIENCE):
                pass
        except ConnectionResetError:
            pass
        return True


async def test_tcp_one_host_at_a_time_and_a_closed_connection_stops_the_sensor() -> None:
    async with on_tcp() as (device, server, port):
        async with Client(port) as first:
            first.writer.write(MD)
            for _ in range(10):
                reply = await first.reply()
            assert len(read(reply).values()) == 1081
            async with Client(port) as second:
                assert await second.end()
            assert server.rejected == 1
            assert read(await first.reply()).status == "99"
        await until(lambda: device.state is State.IDLE)
        async with Client(port) as third:
            third.writer.write(b"BM\n")
            assert await third.reply() == b"BM\n00P\n\n"


async def test_tcp_drops_at_reboot_and_comes_back() -> None:
    async with on_tcp() as (device, _, port):
        async with Client(port) as host:
            host.writer.write(b"RB\nRB\n")
            assert await host.end()
            assert not device.reachable
        async with Client(port) as early:
            assert await early.end()
        await until(lambda: device.state is State.IDLE)
        async with Client(port) as host:
            host.writer.write(b"QT\n")
            assert await host.reply() == b"QT\n00P\n\n"
