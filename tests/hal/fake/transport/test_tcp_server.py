"""The fake lidar on TCP, in real time."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

import pytest

from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import UST_10LX
from hal.fake.transport.tcp_server import TcpServer
from tests.hal.fake.bench import ramp, read
from tests.hal.fake.real_time import PATIENCE, until

MD = b"MD0000108000000\n"

pytestmark = pytest.mark.realtime


Scene = Callable[[FakeHokuyo, TcpServer, int], Awaitable[None]]


def on_tcp(scene: Scene) -> None:
    async def main() -> None:
        device = FakeHokuyo(UST_10LX, ramp(UST_10LX))
        server = TcpServer(device)
        port = await server.listen()
        try:
            await scene(device, server, port)
        finally:
            await server.close()
            device.close()

    asyncio.run(main())


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


def test_tcp_one_host_at_a_time_and_a_closed_connection_stops_the_sensor() -> None:
    async def scene(device: FakeHokuyo, server: TcpServer, port: int) -> None:
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

    on_tcp(scene)


def test_tcp_drops_at_reboot_and_comes_back() -> None:
    async def scene(device: FakeHokuyo, _server: TcpServer, port: int) -> None:
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

    on_tcp(scene)
