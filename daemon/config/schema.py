"""Configuration schema: one typed tree in which every key has a default, a range and a description.

There are few options on purpose (a test limits them to 25): a property that a device reports itself is not an option.
This module contains the tree alone; ``daemon/config/loader.py`` reads, explains and prints it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated

import msgspec
from msgspec import Meta

from daemon.config.endpoints import (
    AUTO,
    NO_DEVICE,
    LidarPlace,
    RtuLine,
    is_address,
    parse_endpoint,
    parse_lidar,
    parse_line,
    parse_network,
    subscription_port,
)

PROFILES = ("A", "B", "D")
"""Air interface profiles (docs/air-interface.md)."""

Port = Annotated[int, Meta(ge=0, le=65535)]
Metres = Annotated[float, Meta(ge=-100.0, le=100.0)]
Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]


def _check_network(key: str, name: str, parse: Callable[[str], object]) -> None:
    """Raise ValueError for a ``tcp://`` name that cannot be opened; the port is optional, with a default by kind."""
    from hal.errors import DeviceRefused

    try:
        parse(name)
    except DeviceRefused:
        raise ValueError(f"Expected tcp://host or tcp://host:port in `{key}`, got `{name}`") from None


def _named(key: str, parse: Callable[[str], object], text: str) -> None:
    """Raise the ValueError of ``parse`` with the key added."""
    try:
        parse(text)
    except ValueError as error:
        raise ValueError(f"{error} in `{key}`") from None


class Mount(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Where the lidar sits on the robot, in base_link: x forward, y left, yaw counter-clockwise seen from above."""

    x: Annotated[Metres, Meta(description="metres ahead of the robot's centre")] = 0.0
    y: Annotated[Metres, Meta(description="metres to the left of the robot's centre")] = 0.0
    yaw: Annotated[Degrees, Meta(description="degrees, counter-clockwise rotation of the lidar's front axis")] = 0.0
    inverted: Annotated[bool, Meta(description="true if the lidar is mounted upside down")] = False


class Mask(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Beams to ignore, because the robot itself stands in them."""

    sectors: Annotated[
        tuple[tuple[Degrees, Degrees], ...],
        Meta(
            description="[from, to] in degrees in the lidar's own frame, counter-clockwise from `from` to `to`",
            examples=[((-135.0, -120.0), (120.0, 135.0))],
        ),
    ] = ()
    near: Annotated[float, Meta(ge=0.0, le=10.0, description="metres; nearer ranges are ignored")] = 0.05

    def __post_init__(self) -> None:
        for begin, end in self.sectors:
            if begin == end:
                raise ValueError(f"Expected two different bearings in `sectors`, got [{begin}, {end}]")


class LidarConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The lidar: where it is connected and how it is mounted. What it can do it says itself."""

    device: Annotated[
        str,
        Meta(
            min_length=1,
            description="auto (search), auto:SERIAL (that sensor), a path such as /dev/ttyACM0 or "
            "/dev/ttyUSB0@115200 (fixed line rate), tcp://host:port (default port 10940), or none (light "
            "only)",
        ),
    ] = "auto"
    intensity: Annotated[bool, Meta(description="true to read intensities too, if the model supports it")] = False
    mount: Mount = Mount()
    mask: Mask = Mask()

    def __post_init__(self) -> None:
        if self.device not in (AUTO, NO_DEVICE) and not re.match(r"/.|[\w-]+:.", self.device):
            raise ValueError(
                "Expected `auto`, `auto:SERIAL`, `none`, a path such as /dev/ttyACM0 or tcp://host:port, "
                f"got `{self.device}` in `device`"
            )
        if self.device.startswith("tcp://"):
            from hal.port.tcp_port import parse_tcp_name

            _check_network("device", self.device, parse_tcp_name)
        _named("device", parse_lidar, self.device)

    @property
    def place(self) -> LidarPlace:
        """Parts of the device string."""
        return parse_lidar(self.device)

    @property
    def fitted(self) -> bool:
        """Whether the robot has a lidar."""
        return self.device != NO_DEVICE


def parse_chip(text: str) -> tuple[str, int, int | None]:
    """Split ``chip@address`` or ``chip@address/channel`` into its parts; the channel is None where there is none.

    Raises:
        ValueError: states what is wrong and what was expected.
    """
    match = re.fullmatch(r"(?P<chip>\w+)@(?P<address>0[xX][0-9A-Fa-f]{1,2}|\d{1,3})(?:/(?P<channel>\d))?", text)
    if match is None:
        raise ValueError(f"Expected type@address, as in mcp3221@0x4d, got `{text}`")
    channel = None if match["channel"] is None else int(match["channel"])
    return match["chip"], int(match["address"], 0), channel


class PhotodiodeConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The photodiode that sees the ceiling lights: where its converter is connected. How it sits is in the survey."""

    bus: Annotated[
        str,
        Meta(
            description="I2C bus of its converter: /dev/i2c-1, adapter:NAME, unix:/path or tcp://host:port; "
            "empty: none",
            examples=["/dev/i2c-1"],
        ),
    ] = ""
    converter: Annotated[str, Meta(description="its converter, type@address: mcp3221, adc121c021 or adc121c027")] = (
        "mcp3221@0x4d"
    )
    level: Annotated[
        str,
        Meta(
            description="DC channel that distinguishes darkness from saturation, type@address/channel: ads1115@0x48/0; "
            "empty: none",
            examples=["ads1115@0x48/0"],
        ),
    ] = ""
    profile: Annotated[str, Meta(description="air interface of the lamps: A, B or D")] = "A"

    def __post_init__(self) -> None:
        from hal.photodiode.chips import chip_named

        if self.bus and not re.match(r"/.|adapter:.|unix:/.|tcp://.", self.bus):
            raise ValueError(
                f"Expected /dev/i2c-1, adapter:NAME, unix:/path or tcp://host:port in `bus`, got `{self.bus}`"
            )
        if self.bus.startswith("tcp://"):
            from hal.bus.i2c_remote import parse_address

            _check_network("bus", self.bus, parse_address)
        try:
            name, address, channel = parse_chip(self.converter)
            chip = chip_named(name)
        except ValueError as error:
            raise ValueError(f"{error} in `converter`") from None
        if channel is not None or address not in chip.addresses:
            possible = ", ".join(f"{a:#04x}" for a in sorted(chip.addresses))
            raise ValueError(f"Expected {name}@ADDRESS in `converter`, one of {possible}, got `{self.converter}`")
        if self.profile not in PROFILES:
            raise ValueError(f"Expected one of {', '.join(PROFILES)} in `profile`, got `{self.profile}`")
        if self.level:
            self._check_level(address)

    def _check_level(self, converter: int) -> None:
        from hal.photodiode.dc_channel import LevelInput

        try:
            chip, address, channel = parse_chip(self.level)
            if channel is None or address == converter:
                raise ValueError(
                    f"Expected type@address/channel with another address than the converter, got `{self.level}`"
                )
            LevelInput(chip, address, channel)
        except ValueError as error:
            raise ValueError(f"{error} in `level`") from None

    @property
    def fitted(self) -> bool:
        """Whether the robot has a photodiode."""
        return bool(self.bus)


class LightsConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """What is known of the ceiling lights."""

    survey: Annotated[
        str,
        Meta(
            description="survey file of lamps and receiver, relative to this file; empty: lamps describe themselves",
            examples=["lights.toml"],
        ),
    ] = ""


NO_FOLDER = "none"
"""Map folder value by which no map is stored: maps end with the process."""


class MapConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The map that outlives the process."""

    folder: Annotated[
        str,
        Meta(
            description="folder for maps, relative to this file; empty: the state directory, none: maps are not stored",
            examples=["maps"],
        ),
    ] = ""
    localise: Annotated[bool, Meta(description="true to use the stored map unchanged and never write it")] = False

    def __post_init__(self) -> None:
        if self.localise and not self.kept:
            raise ValueError("Expected a folder that holds a map, because `localise` is true, in `folder`, got `none`")

    @property
    def kept(self) -> bool:
        """Whether maps are stored at all."""
        return self.folder != NO_FOLDER


class OdometryConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Optional input of wheel odometry and gyro readings."""

    port: Annotated[Port, Meta(description="UDP port for odometry and IMU datagrams; 0: none", examples=[9001])] = 0


class CycleConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The cycle: one per scan."""

    budget_ms: Annotated[
        float, Meta(ge=0.0, le=1000.0, description="time budget of a cycle in milliseconds; 0: half of the scan period")
    ] = 0.0


class ModbusConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Modbus server: on UDP and TCP, and on a serial line."""

    port: Annotated[Port, Meta(description="UDP and TCP port; 0: no Modbus")] = 1502
    serial: Annotated[
        str,
        Meta(
            description="serial line for RTU, such as /dev/ttyUSB1@115200,8N1#1: path, line rate (default "
            "19200), format (default 8E1), unit (default 1); empty: none",
            examples=["/dev/ttyUSB1@115200#1"],
        ),
    ] = ""
    write: Annotated[bool, Meta(description="true to accept writes (commands, odometry)")] = False

    def __post_init__(self) -> None:
        if self.serial:
            _named("serial", parse_line, self.serial)

    @property
    def line(self) -> RtuLine | None:
        """The serial line of Modbus RTU; None: none."""
        return parse_line(self.serial) if self.serial else None


class IntegrityConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The bound on the position error that is published with every pose, and what it may be."""

    alert_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=60.0,
            description="alert limit in metres for the protection level; 0: none",
        ),
    ] = 0.0


class PoseConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """UDP pose datagrams, one per cycle."""

    receivers: Annotated[
        tuple[str, ...],
        Meta(
            description="receivers, each `host:port`, also a multicast group; `*:port`: all clients that "
            "subscribe at that port",
            examples=[("192.168.0.20:9000", "*:9000")],
        ),
    ] = ()

    def __post_init__(self) -> None:
        for index, receiver in enumerate(self.receivers):
            _named(f"receivers[{index}]", parse_endpoint, receiver)
        if len([receiver for receiver in self.receivers if receiver.startswith("*")]) > 1:
            raise ValueError("Expected one port to subscribe on, `*:port`, in `receivers`")


class Config(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """All of it."""

    name: Annotated[
        str,
        Meta(
            pattern=r"^[A-Za-z0-9_.-]{1,32}$",
            description="this robot's name in logs and recordings: 1 to 32 letters (a to z), digits, `_`, `.` and `-`",
            examples=["agv-11"],
        ),
    ] = "lumiloop"
    bind: Annotated[
        str,
        Meta(description="address of this computer for the servers; 0.0.0.0: reachable from every network"),
    ] = "127.0.0.1"
    allow: Annotated[
        tuple[str, ...],
        Meta(
            description="addresses and networks (192.168.0.0/24) with access; empty: all that reach `bind`",
            examples=[("192.168.0.0/24", "10.0.0.7")],
        ),
    ] = ()
    lidar: LidarConfig = LidarConfig()
    photodiode: PhotodiodeConfig = PhotodiodeConfig()
    lights: LightsConfig = LightsConfig()
    map: MapConfig = MapConfig()
    odometry: OdometryConfig = OdometryConfig()
    cycle: CycleConfig = CycleConfig()
    modbus: ModbusConfig = ModbusConfig()
    pose: PoseConfig = PoseConfig()
    integrity: IntegrityConfig = IntegrityConfig()

    def __post_init__(self) -> None:
        if not is_address(self.bind):
            raise ValueError(f"Expected an IP address of this machine in `bind`, got `{self.bind}`")
        for index, network in enumerate(self.allow):
            _named(f"allow[{index}]", parse_network, network)
        if not self.lidar.fitted and not self.photodiode.fitted:
            raise ValueError("Expected a lidar, because `photodiode.bus` is empty, in `lidar.device`, got `none`")
        if self.modbus.serial and self.lidar.place.device == parse_line(self.modbus.serial).path:
            raise ValueError(
                f"Expected a line that the lidar does not use in `modbus.serial`, got `{self.modbus.serial}`"
            )
        self._check_ports()

    def _check_ports(self) -> None:
        if self.odometry.port and self.odometry.port == self.modbus.port:
            raise ValueError(f"Expected a port other than `modbus.port` in `odometry.port`, got {self.odometry.port}")
        port = subscription_port(self.pose.receivers)
        for key, other in (("odometry.port", self.odometry.port), ("modbus.port", self.modbus.port)):
            if port and port == other:
                raise ValueError(f"Expected a port other than `{key}` in `pose.receivers`, got `*:{port}`")
