"""Endpoint syntax of the configuration: lidar device, RTU line, pose receiver and network, one string each.

lidar       auto, auto:H0906091, /dev/ttyACM0, /dev/ttyUSB0@115200, tcp://host:port, none
RTU line    /dev/ttyUSB1, /dev/ttyUSB1@115200, /dev/ttyUSB1@9600,8N1#17
receiver    host:port, 239.1.2.3:port, [ipv6]:port, *:port
network     192.168.0.0/24, 192.168.0.7, fd00::/8
"""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

AUTO: Final = "auto"
NO_DEVICE: Final = "none"
"""Device string of a robot without a lidar, which is localised by light alone."""
ANYBODY: Final = "*"
"""Host of a receiver that stands for every subscriber."""

SCIP_BAUDS: Final = (19200, 38400, 57600, 115200, 250000, 500000, 750000)
"""Line rates that SCIP defines (command SS, C-42-03320B), bit/s."""
RTU_BAUDS: Final = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
RTU_FORMATS: Final = ("8E1", "8O1", "8N1", "8N2")
DEFAULT_RTU: Final = (19200, "8E1", 1)
"""Rate and format that every device has to support (MODBUS over Serial Line V1.02, 2.5.1 and 3.3), and the first unit.
"""

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_MAPPED_BITS: Final = 96
"""Bits before the IPv4 address in an IPv4-mapped IPv6 address."""


@dataclass(frozen=True, slots=True)
class LidarPlace:
    """Connection of a lidar: ``device`` without its rate, required ``serial``, ``baud`` in bit/s (0: detect)."""

    device: str
    serial: str = ""
    baud: int = 0


@dataclass(frozen=True, slots=True)
class RtuLine:
    """Serial line that serves Modbus RTU: path, bit/s, character format, unit address of this daemon."""

    path: str
    baud: int
    format: str
    unit: int


def parse_endpoint(text: str) -> tuple[str, int]:
    """Split ``host:port`` or ``[ipv6]:port`` into its parts; the host may be ``*``, or a group ``ff15::42%eth0``.

    Raises:
        ValueError: states what is wrong and what was expected.
    """
    match = re.fullmatch(
        r"(?:\[(?P<v6>[0-9A-Fa-f:.]+(?:%[\w.-]+)?)\]|(?P<host>[A-Za-z0-9_.-]+|\*)):(?P<port>\d{1,5})", text
    )
    if match is None:
        raise ValueError(f"Expected `host:port`, `[ipv6]:port` or `*:port`, got `{text}`")
    port = int(match["port"])
    if not 1 <= port <= 65535:
        raise ValueError(f"Expected a port from 1 to 65535, got `{text}`")
    if match["v6"] is not None and not is_address(match["v6"].partition("%")[0]):
        raise ValueError(f"Expected an IPv6 address in the brackets, got `{text}`")
    if match["host"] is not None and not all(
        0 < len(label) < 64 for label in match["host"].removesuffix(".").split(".")
    ):
        raise ValueError(f"Expected a host name of labels with 1 to 63 characters between its dots, got `{text}`")
    return match["v6"] or match["host"], port


def in_url(host: str) -> str:
    """Host in URL notation: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host


def is_address(text: str) -> bool:
    """Whether the text is an IP address."""
    for family in (socket.AF_INET, socket.AF_INET6):
        try:
            socket.inet_pton(family, text)
        except OSError:
            continue
        return True
    return False


def parse_lidar(text: str) -> LidarPlace:
    """Split a lidar's device string into its parts; the part for a driver outside this project is passed on unchanged.

    Raises:
        ValueError: states what is wrong and what was expected.
    """
    if text.startswith(f"{AUTO}:"):
        serial = text.removeprefix(f"{AUTO}:")
        if not re.fullmatch(r"[A-Za-z0-9_-]+", serial):
            raise ValueError(f"Expected a serial number after `auto:`, as in auto:H0906091, got `{text}`")
        return LidarPlace(AUTO, serial)
    if (rate := re.fullmatch(r"(/.*)@(\d+)", text) or re.fullmatch(r"(/dev/tty\w+)@(.*)", text)) is None:
        return LidarPlace(text)
    if not rate[2].isdecimal() or int(rate[2]) not in SCIP_BAUDS:
        raise ValueError(f"Expected a line rate of {', '.join(map(str, SCIP_BAUDS))} after `@`, got `{text}`")
    return LidarPlace(rate[1], baud=int(rate[2]))


def parse_line(text: str) -> RtuLine:
    """Split ``path@rate,format#unit`` into its parts; rate, format and unit are optional.

    Raises:
        ValueError: states what is wrong and what was expected.
    """
    form = r"(?P<path>/[^@#]+)(?:@(?P<baud>\d+)(?:,(?P<format>\w+))?)?(?:#(?P<unit>\d+))?"
    if (match := re.fullmatch(form, text)) is None:
        raise ValueError(f"Expected a path with line rate and unit, as in /dev/ttyUSB1@115200#1, got `{text}`")
    baud, style, unit = DEFAULT_RTU
    line = RtuLine(match["path"], int(match["baud"] or baud), match["format"] or style, int(match["unit"] or unit))
    if line.baud not in RTU_BAUDS:
        raise ValueError(f"Expected a line rate of {', '.join(map(str, RTU_BAUDS))} after `@`, got `{text}`")
    if line.format not in RTU_FORMATS:
        raise ValueError(f"Expected a format of {', '.join(RTU_FORMATS)} after the rate, got `{text}`")
    if not 1 <= line.unit <= 247:
        raise ValueError(f"Expected a unit from 1 to 247 after `#`, got `{text}`")
    return line


def parse_network(text: str) -> Network:
    """Parse an IP address or a network; an IPv4-mapped one (``::ffff:192.168.0.0/120``) is the IPv4 network.

    Raises:
        ValueError: states what is wrong and what was expected.
    """
    try:
        whole = unmapped(ipaddress.ip_network(text, strict=False))
    except ValueError:
        raise ValueError(f"Expected an address or a network such as 192.168.0.0/24, got `{text}`") from None
    try:
        ipaddress.ip_network(text)
    except ValueError:
        raise ValueError(f"Expected `{whole}` (the network) or an address without `/`, got `{text}`") from None
    return whole


def unmapped(network: Network) -> Network:
    """The IPv4 network within an IPv4-mapped one (RFC 4291, 2.5.5.2); any other one unchanged."""
    if network.version == 4 or network.prefixlen < _MAPPED_BITS or network.network_address.ipv4_mapped is None:
        return network
    return ipaddress.IPv4Network((network.network_address.ipv4_mapped, network.prefixlen - _MAPPED_BITS))


def subscription_port(receivers: Sequence[str]) -> int:
    """Port on which subscribers receive pose datagrams; 0: none."""
    return next((port for host, port in map(parse_endpoint, receivers) if host == ANYBODY), 0)


def interface_of(bind: str) -> str:
    """Address in `bind` whose interface multicast datagrams leave by; empty for all addresses."""
    return "" if ipaddress.ip_address(bind).is_unspecified else bind


def is_bus(device: str) -> bool:
    """Whether the text names an I2C bus. ``tcp://`` names a lidar here, so a remote bus is ``i2c+tcp://``."""
    return re.match(r"/dev/i2c-|adapter:|unix:|i2c\+tcp://", device) is not None
