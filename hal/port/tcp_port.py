"""A byte port over TCP, for Ethernet sensors (HOKUYO: port 10940, one client at a time)."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from typing import Final
from urllib.parse import urlsplit

from hal.clock import Clock, SystemClock
from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.net import inet
from hal.port.port import OnData, OnLost

DEFAULT_TCP_PORT: Final = 10940
CONNECT_TIMEOUT_S: Final = 2.0
REFUSED: Final = "check its power and the port; a sensor serves one client, so stop the other"
_DEAD_PEER_S: Final = 3  # a pulled network cable is noticed within this time, even with nothing to send


class TcpPort(asyncio.Protocol):
    """An open TCP connection; see :class:`hal.port.port.Port`. Made by :func:`open_tcp_port`."""

    def __init__(self, name: str, clock: Clock) -> None:
        self._name = name
        self._clock = clock
        self._transport: asyncio.Transport | None = None
        self._on_data: OnData | None = None
        self._on_lost: OnLost | None = None
        self._early: list[tuple[bytes, float]] = []
        self._lost: HalError | None = None
        self._closed = False

    @property
    def name(self) -> str:
        """The device as the user named it."""
        return self._name

    def start(self, on_data: OnData, on_lost: OnLost) -> None:
        """Begin delivering; bytes received since the connection was made come first, with their times."""
        self._on_data, self._on_lost = on_data, on_lost
        asyncio.get_running_loop().call_soon(self._deliver_early)

    def write(self, data: bytes) -> None:
        """Send a command at once; raises `DeviceMissing` if the connection is gone."""
        if self._closed or self._transport is None or self._transport.is_closing():
            raise DeviceMissing(self._name, "the connection is closed")
        self._transport.write(data)

    def set_baud(self, baud: int) -> None:
        """Do nothing: Ethernet has no line rate."""

    def close(self) -> None:
        """Close at once; unsent bytes are dropped."""
        self._closed = True
        self._early.clear()
        if self._transport is not None:
            self._transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the connection is established."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        link: socket.socket = transport.get_extra_info("socket")
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _DEAD_PEER_S - 1)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * _DEAD_PEER_S)

    def data_received(self, data: bytes) -> None:
        """asyncio: bytes have arrived."""
        t_rx = self._clock.now()
        if self._closed:
            return
        if self._on_data is None or self._early:
            self._early.append((data, t_rx))
        else:
            self._on_data(data, t_rx)

    def connection_lost(self, exc: Exception | None) -> None:
        """asyncio: the connection is gone."""
        why = "closed by the sensor" if exc is None else f"lost: {exc}"
        self._lost = DeviceMissing(
            self._name, f"connection {why}", "check its power, its network cable, and that no second client uses it"
        )
        self._deliver_lost()

    def _deliver_early(self) -> None:
        while self._early and self._on_data is not None and not self._closed:
            self._on_data(*self._early.pop(0))
        self._deliver_lost()

    def _deliver_lost(self) -> None:
        if self._lost is not None and self._on_lost is not None and not self._early and not self._closed:
            on_lost, self._on_lost = self._on_lost, None
            on_lost(self._lost)


def parse_tcp_name(device: str) -> tuple[str, int]:
    """Host and port of ``tcp://host[:port]``; raises `DeviceRefused` for anything else."""
    try:
        parts = urlsplit(device)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or port == 0 or parts.path not in ("", "/") or parts.query or parts.username:
        raise DeviceRefused(device, "not a network address", "expected tcp://host or tcp://host:port")
    return host, port or DEFAULT_TCP_PORT


async def open_tcp_port(device: str, clock: Clock | None = None) -> TcpPort:
    """Connect to ``tcp://host[:port]`` within 2 s.

    Raises:
        DeviceMissing: unknown host, unreachable, no answer. DeviceRefused: refused (busy), or not a ``tcp://`` name.
    """
    host, number = parse_tcp_name(device)
    port = TcpPort(device, clock or SystemClock())
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            await _connect(port, await _resolved(device, host, number))
    except TimeoutError as error:
        problem = f"no answer within {CONNECT_TIMEOUT_S:g} s{_unnamed(device)}"
        raise DeviceMissing(device, problem, "check power, cable, address and this host's netmask") from error
    except OSError as error:
        raise _explain(device, error) from error
    return port


def _unnamed(device: str) -> str:
    """Text that names the default port, for a device name without a port."""
    return "" if urlsplit(device).port is not None else f" at port {DEFAULT_TCP_PORT}, the default port"


async def _resolved(device: str, host: str, number: int) -> list[inet.Address]:
    try:
        return await inet.resolve(host, number)
    except DeviceMissing as error:
        raise DeviceMissing(device, f"{host}: {error.problem}", "name the sensor by its IP address") from error


async def _connect(port: TcpPort, addresses: list[inet.Address]) -> None:
    """Connect to the first reachable address; raises the error of the last one."""
    problem = OSError("no address")
    for address in addresses:
        host, interface = address[1][0], inet.scope(address)
        try:
            name = f"{host}%{interface}" if interface else host
            await asyncio.get_running_loop().create_connection(lambda: port, name, address[1][1])
        except OSError as error:
            problem = error
        else:
            return
    raise problem


def _explain(device: str, error: OSError) -> HalError:
    if error.errno == errno.ECONNREFUSED:
        return DeviceRefused(device, f"connection refused{_unnamed(device)}", REFUSED)
    reason = os.strerror(error.errno) if error.errno else str(error)
    return DeviceMissing(device, reason, "check power, cable, address and this host's netmask")
