"""The fake lidar as a network sensor: SCIP over TCP (port 10940 on a real one)."""

from __future__ import annotations

import asyncio

from hal.fake.lidar.device import FakeHokuyo

TCP_QUEUE = 128 * 1024
"""Bytes queued for a host that does not read, before replies are lost."""


class TcpServer:
    """Serves the device over TCP to one host; a second host is rejected; a closed connection stops the sensor.

    An unreachable sensor (no power, cable pulled) closes new connections at once; a real one would not answer.
    """

    def __init__(self, device: FakeHokuyo) -> None:
        self._device = device
        self._transport: asyncio.Transport | None = None
        self._server: asyncio.Server | None = None
        self.rejected = 0

    async def listen(self, host: str = "127.0.0.1", port: int = 0) -> int:
        """Begin to accept; returns the port (a real sensor's is 10940; 0 chooses a free one)."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _TcpConnection(self), host, port)
        return int(self._server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Close the connection and stop accepting."""
        self.hang_up()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def host_connected(self, transport: asyncio.Transport) -> bool:
        """Accept or reject (False) a new connection."""
        if self._transport is not None or not self._device.reachable:
            self.rejected += 1
            transport.abort()
            return False
        self._transport = transport
        self._device.attach(self)
        return True

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        self._device.receive(data)

    def host_disconnected(self) -> None:
        """The host has closed the connection."""
        self._transport = None
        self._device.detach()

    def accept(self, data: bytes) -> bool:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        if self._transport is None or self._transport.get_write_buffer_size() > TCP_QUEUE:
            return False
        self._transport.write(data)
        return True

    def baud(self) -> int:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        return 0

    def hang_up(self) -> None:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        if self._transport is not None:
            self._transport.abort()


class _TcpConnection(asyncio.Protocol):
    def __init__(self, server: TcpServer) -> None:
        self._server = server
        self._accepted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._accepted = self._server.host_connected(transport)

    def data_received(self, data: bytes) -> None:
        if self._accepted:
            self._server.receive(data)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._accepted:
            self._accepted = False
            self._server.host_disconnected()
