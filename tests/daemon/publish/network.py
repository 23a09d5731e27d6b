"""A running publisher and raw clients, for tests over real loopback sockets."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Callable
from typing import Any

from daemon.publish.modbus import tcp_endpoint
from daemon.publish.modbus.server import ModbusPublisher
from hal.clock import SystemClock
from hal.errors import DeviceRefused
from tests.daemon.publish.modbus.test_registers import snapshot

PATIENCE_S = 5.0
BLOCK = (4, 0, 64)


@contextlib.asynccontextmanager
async def publishing(**options: Any) -> AsyncIterator[ModbusPublisher]:
    """A publisher on a free loopback port that shows a snapshot."""
    publisher = ModbusPublisher(SystemClock(), **options)
    for attempt in range(5):  # the free TCP port's number may be in use for UDP by another program
        try:
            await publisher.start("127.0.0.1", 0)
        except DeviceRefused:
            if attempt == 4:
                raise
        else:
            break
    publisher.publish(snapshot())
    try:
        yield publisher
    finally:
        await publisher.close()


def request(transaction: int, function: int, address: int, count: int) -> bytes:
    return struct.pack(">HHHBBHH", transaction, 0, 6, 1, function, address, count)


class Datagrams(asyncio.DatagramProtocol):
    """Keeps every answer that comes."""

    def __init__(self) -> None:
        self.answers: list[bytes] = []
        self._news = asyncio.Event()

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self.answers.append(data)
        self._news.set()

    async def wait_for(self, count: int) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while len(self.answers) < count:
                self._news.clear()
                await self._news.wait()


@contextlib.asynccontextmanager
async def udp_client(port: int, host: str = "127.0.0.1") -> AsyncIterator[tuple[asyncio.DatagramTransport, Datagrams]]:
    loop = asyncio.get_running_loop()
    transport, protocol = await loop.create_datagram_endpoint(Datagrams, remote_addr=(host, port))
    try:
        yield transport, protocol
    finally:
        transport.close()
        await asyncio.sleep(0)


@contextlib.asynccontextmanager
async def tcp_client(port: int) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def read_answer(reader: asyncio.StreamReader) -> bytes:
    async with asyncio.timeout(PATIENCE_S):
        head = await reader.readexactly(6)
        return head + await reader.readexactly(int.from_bytes(head[4:6], "big"))


async def until(condition: Callable[[], bool]) -> None:
    """Wait for something that the publisher does not tell; fails when it does not come."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  # there is no event to wait for
            await asyncio.sleep(0.002)


async def closed(reader: asyncio.StreamReader) -> bytes:
    """What still comes before the server closes; fails if it does not close."""
    async with asyncio.timeout(PATIENCE_S):
        try:
            return await reader.read()
        except ConnectionResetError:
            return b""


def taken_port() -> socket.socket:
    """A socket that occupies a TCP port."""
    sock = socket.socket()
    sock.bind(("127.0.0.1", 0))
    sock.listen()
    return sock


class Wire(asyncio.Transport):
    """A connection's transport without a network."""

    def __init__(self, protocol: asyncio.Protocol, host: str = "") -> None:
        super().__init__({"peername": (host, 5000)} if host else None)
        self._protocol = protocol
        self.sent = bytearray()
        self.gone = False
        self.reading = True

    def write(self, data: Any) -> None:
        self.sent += data

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def is_reading(self) -> bool:
        return self.reading

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True

    def is_closing(self) -> bool:
        return self.gone

    def close(self) -> None:
        self.gone = True
        asyncio.get_running_loop().call_soon(self._protocol.connection_lost, None)

    abort = close


def plugged(endpoint: tcp_endpoint.TcpEndpoint, host: str = "") -> tuple[tcp_endpoint.Connection, Wire]:
    """A connection, from this address, on a transport without a network."""
    connection = tcp_endpoint.Connection(endpoint)
    wire = Wire(connection, host)
    connection.connection_made(wire)
    return connection, wire
