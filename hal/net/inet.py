"""Internet addresses and listening sockets: look-up, interfaces, bind errors with their remedies."""

from __future__ import annotations

import errno
import ipaddress
import socket
from functools import partial
from typing import Any, Final

from hal.blocking_calls import run_in_thread
from hal.errors import DeviceMissing, DeviceRefused, HalError

Address = tuple[socket.AddressFamily, tuple[str, int] | tuple[str, int, int, int]]
"""Family and what `bind` and `sendto` take; the longer one names the network interface (IPv6 scope), flow 0."""

PRIVILEGED: Final = 1024


def scope(address: Address) -> int:
    """Number of the network interface that an address names, 0: none."""
    where = address[1]
    return where[3] if len(where) == 4 else 0


def is_group(address: Address) -> bool:
    """Whether an address is a multicast group."""
    return ipaddress.ip_address(address[1][0].partition("%")[0]).is_multicast


def with_port(address: Address, port: int) -> Address:
    """The same address with another port."""
    family, where = address
    return family, (where[0], port) if len(where) == 2 else (where[0], port, where[2], where[3])


def _addresses(found: list[Any], index: int = 0) -> list[Address]:
    """Addresses without repetitions; ``index``: of the interface that the host name gave."""
    addresses: list[Address] = []
    for family, _, _, _, (host, port, *more) in found:
        interface = index or (more[1] if more else 0)
        where = (str(host), int(port), 0, interface) if family == socket.AF_INET6 and interface else (host, int(port))
        addresses.append((family, where))
    return list(dict.fromkeys(addresses))


def _interface(host: str) -> tuple[str, int]:
    """Split a host into its name and the number of its interface, 0: none (RFC 4007, 11).

    The system's look-up accepts interface names only after link-local addresses, not after site-local groups.

    Raises:
        OSError: no such interface at present.
    """
    bare, percent, name = host.partition("%")
    if not percent:
        return host, 0
    return bare, int(name) if name.isascii() and name.isdigit() else socket.if_nametoindex(name)


def _interfaces() -> str:
    """Names of this computer's network interfaces, or how to find them."""
    try:
        return ", ".join(name for _, name in socket.if_nameindex())
    except OSError:  # the service manager's RestrictAddressFamilies= leaves netlink out
        return "ip link"


def numeric(host: str, port: int, flags: int = 0) -> list[Address]:
    """Addresses of a numeric host, without a look-up; none for a name, or for an interface that does not exist."""
    try:
        bare, index = _interface(host)
        flags |= socket.AI_NUMERICHOST
        return _addresses(socket.getaddrinfo(bare or None, port, type=socket.SOCK_DGRAM, flags=flags), index)
    except (OSError, UnicodeError):  # a name, or text that cannot be one
        return []


async def resolve(host: str, port: int, *, passive: bool = False) -> list[Address]:
    """Addresses of a host; a numeric one is never looked up, a name is looked up in a thread.

    Args:
        host: name or numeric address; empty with `passive`: every address of this computer.
        port: copied into the addresses.
        passive: whether the addresses are for listening.

    Raises:
        DeviceMissing: the name is unknown at present or malformed, or there is no such network interface.
    """
    flags = socket.AI_PASSIVE if passive else 0
    if found := numeric(host, port, flags):
        return found
    try:
        _interface(host)
    except OSError as error:
        problem = f"no network interface {host.partition('%')[2]} on this computer"
        raise DeviceMissing(f"{host}:{port}", problem, f"name an existing one: {_interfaces()}") from error
    look_up = partial(socket.getaddrinfo, host, port, type=socket.SOCK_DGRAM, flags=flags)
    try:
        return _addresses(await run_in_thread(look_up, "names"))
    except UnicodeError as error:
        remedy = "its labels, between dots, have 1 to 63 characters each"
        raise DeviceMissing(f"{host}:{port}", "not a host name", remedy) from error
    except socket.gaierror as error:
        remedy = "write a numeric address, or make the name resolvable on this computer"
        raise DeviceMissing(f"{host}:{port}", f"host name not known: {error.strerror}", remedy) from error


def listening(address: Address, kind: socket.SocketKind) -> socket.socket:
    """Return a bound, non-blocking socket (an IPv6 one accepts IPv6 only). Raises OSError, see :func:`refusal`."""
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
    """The error to raise when a socket cannot be bound.

    Args:
        device: the service for the message (``Modbus on 127.0.0.1:1502``).
        option: configuration key of the port, for the remedy.
        port: the requested number.
        error: as the operating system raised it.
    """
    if error.errno == errno.EADDRINUSE:
        return DeviceRefused(device, "the port is in use", f"stop the other program, or choose another {option}")
    if error.errno in (errno.EACCES, errno.EPERM) and 0 < port < PRIVILEGED:
        remedy = (
            f"ports below {PRIVILEGED} need a capability; choose another {option} (Modbus: 1502), or set "
            "AmbientCapabilities=CAP_NET_BIND_SERVICE"
        )
        return DeviceRefused(device, "permission denied", remedy)
    if error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
        remedy = "set bind to an address of this computer (0.0.0.0: all, 127.0.0.1: this computer only)"
        return DeviceMissing(device, "this computer does not have that address", remedy)
    return DeviceRefused(device, error.strerror or str(error), "read the system log")
