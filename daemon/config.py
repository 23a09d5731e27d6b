"""The one configuration tree: typed, every key with a default, a range and a description.

Few options on purpose (a test holds them to 25): what a device states about itself is not an option. This module is
the tree alone; ``daemon/configfile.py`` reads, explains and prints it.
"""

from __future__ import annotations

import re
import socket
from typing import Annotated

import msgspec
from msgspec import Meta

BAUDS = (0, 19200, 38400, 57600, 115200, 250000, 500000, 750000)
"""Line rates that SCIP knows (command SS, C-42-03320B), and 0."""

Port = Annotated[int, Meta(ge=0, le=65535)]
Metres = Annotated[float, Meta(ge=-100.0, le=100.0)]
Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]


def parse_endpoint(text: str) -> tuple[str, int]:
    """Split ``host:port`` or ``[ipv6]:port`` into its parts.

    Raises:
        ValueError: naming what is wrong and what was expected.
    """
    match = re.fullmatch(r"(?:\[(?P<v6>[0-9A-Fa-f:.]+)\]|(?P<host>[A-Za-z0-9_.-]+)):(?P<port>\d{1,5})", text)
    if match is None:
        raise ValueError(f"Expected `host:port` or `[ipv6]:port`, got `{text}`")
    port = int(match["port"])
    if not 1 <= port <= 65535:
        raise ValueError(f"Expected a port from 1 to 65535, got `{text}`")
    if match["v6"] is not None and not _is_address(match["v6"]):
        raise ValueError(f"Expected an IPv6 address in the brackets, got `{text}`")
    return match["v6"] or match["host"], port


def _is_address(text: str) -> bool:
    for family in (socket.AF_INET, socket.AF_INET6):
        try:
            socket.inet_pton(family, text)
        except OSError:
            continue
        return True
    return False


class Mount(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Where the lidar sits on the robot, in base_link: x forward, y left, yaw counter-clockwise seen from above."""

    x: Annotated[Metres, Meta(description="metres ahead of the robot's centre")] = 0.0
    y: Annotated[Metres, Meta(description="metres to the left of the robot's centre")] = 0.0
    yaw: Annotated[Degrees, Meta(description="degrees the lidar's front axis is turned counter-clockwise")] = 0.0
    inverted: Annotated[bool, Meta(description="true when the lidar hangs upside down")] = False


class Mask(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Beams to ignore, because the robot itself stands in them."""

    sectors: Annotated[
        tuple[tuple[Degrees, Degrees], ...],
        Meta(description="[from, to] in degrees in the lidar's own frame, counter-clockwise from `from` to `to`"),
    ] = ()
    near: Annotated[float, Meta(ge=0.0, le=10.0, description="metres; everything nearer is ignored")] = 0.05

    def __post_init__(self) -> None:
        for begin, end in self.sectors:
            if begin == end:
                raise ValueError(f"Expected two different bearings in `sectors`, got [{begin}, {end}]")


class LidarConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The lidar: where it is connected and how it is mounted. What it can do it says itself."""

    device: Annotated[
        str,
        Meta(min_length=1, description="auto (look for one), a path such as /dev/ttyACM0, or tcp://host:port"),
    ] = "auto"
    serial: Annotated[str, Meta(description="serial number to insist on where several are connected; empty: any")] = ""
    baud: Annotated[int, Meta(description="line rate of a real serial line; 0: find it; USB and TCP ignore it")] = 0
    intensity: Annotated[bool, Meta(description="true to read intensities too, where the model can")] = False
    mount: Mount = Mount()
    mask: Mask = Mask()

    def __post_init__(self) -> None:
        if self.device != "auto" and not re.match(r"/.|[\w-]+:.", self.device):
            raise ValueError(f"Expected `auto`, a path such as /dev/ttyACM0 or tcp://host:port, got `{self.device}`")
        if self.baud not in BAUDS:
            raise ValueError(f"Expected one of {', '.join(map(str, BAUDS))} in `baud`, got {self.baud}")


class OdometryConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Optional input of wheel odometry and gyro readings."""

    port: Annotated[Port, Meta(description="UDP port that takes odometry and IMU datagrams; 0: none")] = 0


class CycleConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The cycle: one per scan."""

    budget_ms: Annotated[
        float, Meta(ge=0.0, le=1000.0, description="milliseconds one cycle may take; 0: half of the scan period")
    ] = 0.0


class ModbusConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Modbus server, on UDP and on TCP."""

    port: Annotated[Port, Meta(description="UDP and TCP port; 0: no Modbus")] = 1502
    write: Annotated[bool, Meta(description="true to accept writes (commands, odometry)")] = False


class PoseConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """UDP pose datagrams, one per cycle."""

    receivers: Annotated[tuple[str, ...], Meta(description="where to send them, each `host:port`")] = ()

    def __post_init__(self) -> None:
        for index, receiver in enumerate(self.receivers):
            try:
                parse_endpoint(receiver)
            except ValueError as error:
                raise ValueError(f"{error} in `receivers[{index}]`") from None


class Config(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """All of it."""

    name: Annotated[
        str, Meta(pattern=r"^[A-Za-z0-9_.-]{1,32}$", description="this robot's name in logs and recordings")
    ] = "lumiloop"
    bind: Annotated[
        str,
        Meta(description="address of this machine the servers listen on; 0.0.0.0: reachable from every network"),
    ] = "127.0.0.1"
    lidar: LidarConfig = LidarConfig()
    odometry: OdometryConfig = OdometryConfig()
    cycle: CycleConfig = CycleConfig()
    modbus: ModbusConfig = ModbusConfig()
    pose: PoseConfig = PoseConfig()

    def __post_init__(self) -> None:
        if not _is_address(self.bind):
            raise ValueError(f"Expected an IP address of this machine in `bind`, got `{self.bind}`")
        if self.odometry.port and self.odometry.port == self.modbus.port:
            raise ValueError(f"Expected a port other than Modbus's in `odometry.port`, got {self.odometry.port}")
