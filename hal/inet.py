"""Internet addresses and sockets that this computer listens on; errors say what to do."""

from __future__ import annotations

import asyncio
import errno
import socket
from typing import Any, Final

from hal.errors import DeviceMissing, DeviceRefused, HalError

Address = tuple[socket.AddressFamily, tuple[str, int]]
"""Family and what `bind` and `sendto` take (IPv6 scope and flow are left at 0)."""

PRIVILEGED: Final = 1024


def _addresses(found: list[Any]) -> list[Address]:
    return list(dict.fromkeys((family, (str(address[0]), int(address[1]))) for family, _, _, _, address in found))


def numeric(host: str, port: int, flags: int = 0) -> list[Address]:
    """Addresses of a numeric host, without any look-up; none where it is a name."""
    try:
        flags |= socket.AI_NUMERICHOST
        return _addresses(socket.getaddrinfo(host or None, port, type=socket.SOCK_DGRAM, flags=flags))
    except socket.gaierror:
        return []


async def resolve(host: str, port: int, *, passive: bool = False) -> list[Address]:
    """Addresses of a host; a numeric one is never looked up, a name is looked up beside the event loop.

    Args:
        host: name or numeric address; empty with `passive`: every address of this computer.
        port: goes into the addresses unchanged.
        passive: whether the addresses are to be listened on.

    Raises:
        DeviceMissing: the name is not known (now).
    """
    flags = socket.AI_PASSIVE if passive else 0
    if found := numeric(host, port, flags):
        return found
    loop = asyncio.get_running_loop()
    try:
        return _addresses(await loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=flags))
    except socket.gaierror as error:
        remedy = "write a numeric address, or make the name resolvable on this computer"
        raise DeviceMissing(f"{host}:{port}", f"host name not known: {error.strerror}", remedy) from error


def listening(address: Address, kind: socket.SocketKind) -> socket.socket:
    """A bound, non-blocking socket (an IPv6 one takes IPv6 only). Raises OSError, see :func:`refusal`."""
    family, where = address
    # asyncio switches Nagle's algorithm off only on sockets that were made with their protocol's number
    protocol = socket.IPPROTO_TCP if kind == socket.SOCK_STREAM else socket.IPPROTO_UDP
    sock = socket.socket(family, kind, protocol)
    try:
        sock.setblocking(False)
        if kind == socket.SOCK_STREAM:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        sock.bind(where)
    except OSError:
        sock.close()
        raise
    return sock


def refusal(device: str, option: str, port: int, error: OSError) -> HalError:
    """The error to raise when a socket cannot be listened on.

    Args:
        device: what was to be opened, as a person knows it (``Modbus on 127.0.0.1:1502``).
        option: configuration key of the port, named in the remedy.
        port: the number that was asked for.
        error: what the operating system said.
    """
    if error.errno == errno.EADDRINUSE:
        return DeviceRefused(device, "the port is in use", f"stop the other program, or choose another {option}")
    if error.errno in (errno.EACCES, errno.EPERM) and 0 < port < PRIVILEGED:
        remedy = (
            f"ports below {PRIVILEGED} need a capability: choose another {option} (Modbus: 1502), or give the service "
            "AmbientCapabilities=CAP_NET_BIND_SERVICE"
        )
        return DeviceRefused(device, "permission denied", remedy)
    if error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
        remedy = "set bind to an address of this computer (0.0.0.0: all, 127.0.0.1: this computer only)"
        return DeviceMissing(device, "this computer does not have that address", remedy)
    return DeviceRefused(device, error.strerror or str(error), "see the system's log")
