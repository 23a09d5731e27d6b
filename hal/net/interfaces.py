"""Number of the network interface that has an address of this computer.

Services may have no netlink (RestrictAddressFamilies=), so the addresses come from an ioctl (netdevice(7), SIOCGIFCONF)
and from `/proc/net/if_inet6`.
"""

from __future__ import annotations

import array
import errno
import fcntl
import ipaddress
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

_SIOCGIFCONF: Final = 0x8912
_IFREQ: Final = struct.Struct("@16s16s8x" if struct.calcsize("P") == 8 else "@16s16s")
"""`struct ifreq`: name, and a socket address, whose IPv4 address begins at byte 4."""
_IFCONF: Final = struct.Struct("@iP")
_MOST: Final = 256
_IF_INET6: Final = Path("/proc/net/if_inet6")

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address


def interface_of(address: str) -> int:
    """Number of the interface with this address.

    Raises:
        OSError: no interface has it at present.
    """
    wanted = ipaddress.ip_address(address)
    for found, index in _ipv4() if wanted.version == 4 else _ipv6():
        if found == wanted:
            return index
    if wanted.is_loopback:  # 127.0.0.0/8 belongs to the loopback interface as a whole
        return socket.if_nametoindex("lo")
    raise OSError(errno.EADDRNOTAVAIL, os.strerror(errno.EADDRNOTAVAIL))


def _ipv4() -> Iterator[tuple[IpAddress, int]]:
    space = array.array("B", bytes(_MOST * _IFREQ.size))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        asked = _IFCONF.pack(len(space), space.buffer_info()[0])
        size, _ = _IFCONF.unpack(fcntl.ioctl(sock, _SIOCGIFCONF, asked))
    for name, where in _IFREQ.iter_unpack(space.tobytes()[: size // _IFREQ.size * _IFREQ.size]):
        text = name.partition(b"\0")[0].decode(errors="surrogateescape").partition(":")[0]  # an alias is eth0:1
        yield ipaddress.IPv4Address(where[4:8]), socket.if_nametoindex(text)


def _ipv6() -> Iterator[tuple[IpAddress, int]]:
    lines = _IF_INET6.read_text().splitlines() if _IF_INET6.exists() else []
    for line in lines:
        digits, index, *_ = line.split()
        yield ipaddress.IPv6Address(bytes.fromhex(digits)), int(index, 16)
