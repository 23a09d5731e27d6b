"""The one configuration tree: typed TOML, every key with a default, an unknown key or a wrong value refused by path.

Few options on purpose (a test holds them to 25): what a device states about itself is not an option.
"""

from __future__ import annotations

import msgspec


class Mount(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Where a sensor sits on the robot: metres and degrees in base_link (x forward, y left, yaw counter-clockwise)."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    inverted: bool = False


class Mask(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Beams to ignore: sectors of bearings in degrees in the lidar's own frame, and everything nearer than `near` m."""

    sectors: tuple[tuple[float, float], ...] = ()
    near: float = 0.05


class LidarConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The lidar: where it is connected, which one it is, how it is mounted."""

    device: str = "auto"
    serial: str = ""
    baud: int = 0
    intensity: bool = False
    mount: Mount = Mount()
    mask: Mask = Mask()


class OdometryConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Optional inputs: a UDP port that takes odometry and IMU datagrams (0: none)."""

    port: int = 0


class CycleConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The cycle: its time budget in ms (0: half of the learned scan period)."""

    budget_ms: float = 0.0


class ModbusConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Modbus server on UDP and TCP (0: off) and whether writes (commands, odometry) are allowed."""

    port: int = 1502
    write: bool = False


class PoseConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Receivers of UDP pose datagrams, each `host:port`."""

    receivers: tuple[str, ...] = ()


class Config(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """All of it."""

    name: str = "lumiloop"
    bind: str = "127.0.0.1"
    state_dir: str = ""
    lidar: LidarConfig = LidarConfig()
    odometry: OdometryConfig = OdometryConfig()
    cycle: CycleConfig = CycleConfig()
    modbus: ModbusConfig = ModbusConfig()
    pose: PoseConfig = PoseConfig()
