"""Calibration of odometry and lidar mount from a drive, and its findings as text and configuration."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from msgspec.structs import replace

from daemon.commissioning.teach_drive import Drive, poses_at
from daemon.config.schema import Config
from estimator.calibration import Wheel, WheelFit, fit_wheels, on_base
from hal.errors import DataInvalid

_ODOMETRY: Final = (Wheel.SCALE, Wheel.TURN, Wheel.DRIFT)
_MOUNT: Final = (Wheel.MOUNT_X, Wheel.MOUNT_Y, Wheel.MOUNT_YAW)


def findings(fit: WheelFit, odometry: bool, mount: bool) -> list[str]:
    """Returns the requested results of the fit as text lines."""
    pair = [f"{1e3 * way:.1f} mm {_deg(turn):.3f} deg" for way, turn in (fit.before, fit.after)]
    lines = [f"{fit.steps} steps; odometry minus lidar, rms: {pair[0]} before, {pair[1]} after"]
    if odometry:
        lines += [_line(fit, which) for which in _ODOMETRY]
        lines.append("multiply the wheel radii by `scale`, and the track by `scale / turn`")
    return lines + [_line(fit, which) for which in _MOUNT if mount]


def with_mount(config: Config, fit: WheelFit) -> Config:
    """Returns the configuration with the fitted lidar mount."""
    x, y, yaw = fit.value[Wheel.MOUNT_X :]
    place = replace(
        config.lidar.mount, x=_rounded(x, 4), y=_rounded(y, 4), yaw=_rounded(math.remainder(_deg(yaw), 360.0), 3)
    )
    return replace(config, lidar=replace(config.lidar, mount=place))


def _rounded(value: float, decimals: int) -> float:
    return round(float(value), decimals) + 0.0  # no -0.0


def configuration_lines(config: Config) -> list[str]:
    """Returns the command that writes the mount into the configuration file."""
    mount = config.lidar.mount
    values = (("x", f"{mount.x:.4f}"), ("y", f"{mount.y:.4f}"), ("yaw", f"{mount.yaw:.3f}"))
    return ["", f"lumiloop config set {' '.join(f'lidar.mount.{name}={value}' for name, value in values)}", ""]


def fit_drive(drive: Drive) -> WheelFit:
    """Fits odometry to the lidar poses over the whole drive; raises `DataInvalid`."""
    if len(drive.readings) < 2:
        raise DataInvalid(
            str(drive.path),
            "the recording has no odometry",
            "set `odometry.port`, send readings to it, and record again",
        )
    stamps, first = np.unique(drive.readings[:, 0], return_index=True)
    wheels = drive.readings[first, 1:].copy()
    wheels[:, 2] = np.unwrap(wheels[:, 2])
    laser_t = drive.poses.stamps
    inside = (laser_t >= stamps[0]) & (laser_t <= stamps[-1])
    said = np.column_stack([np.interp(laser_t[inside], stamps, wheels[:, k]) for k in range(3)])
    base, _ = poses_at(drive.poses, laser_t[inside])
    try:
        return fit_wheels(said, on_base(base, drive.mount), drive.mount)
    except ValueError as error:
        raise DataInvalid(str(drive.path), str(error), "turn on the spot, and drive curves to both sides") from error


def _line(fit: WheelFit, which: Wheel) -> str:
    value, sigma = fit.value[which], fit.sigma[which]
    unit = {Wheel.DRIFT: " deg/m", Wheel.MOUNT_YAW: " deg", Wheel.MOUNT_X: " m", Wheel.MOUNT_Y: " m"}.get(which, "")
    if unit.startswith(" deg"):
        value, sigma = _deg(value), _deg(sigma)
    told = "" if fit.told[which] else "  not determined by this drive"
    return f"{which.name.lower():<10} {value:>9.4f} +-{sigma:.4f}{unit}{told}"


def _deg(rad: float) -> float:
    return math.degrees(float(rad))
