"""`lumiloop calibrate REC --odometry --lidar-mount`: wheels and laser mount, as text."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from daemon.teach import Drive, poses_at
from estimator.calibrate_wheels import Wheel, WheelFit, fit_wheels, on_base
from hal.errors import DataInvalid

_ODOMETRY: Final = (Wheel.SCALE, Wheel.TURN, Wheel.DRIFT)
_MOUNT: Final = (Wheel.MOUNT_X, Wheel.MOUNT_Y, Wheel.MOUNT_YAW)


def report_wheels(drive: Drive, odometry: bool, mount: bool) -> str:
    """Fit and say it.

    Raises:
        DataInvalid: no odometry in the recording, or too little motion.
    """
    fit = fit_drive(drive)
    pair = [f"{1e3 * way:.1f} mm {_deg(turn):.3f} deg" for way, turn in (fit.before, fit.after)]
    lines = [f"{fit.steps} steps; wheels against laser, rms: {pair[0]} before, {pair[1]} after"]
    if odometry:
        lines += [_line(fit, which) for which in _ODOMETRY]
        lines.append("multiply the wheels' radii by `scale`, and the track by `scale / turn`")
    if mount:
        lines += [_line(fit, which) for which in _MOUNT]
        x, y, yaw = fit.value[Wheel.MOUNT_X :]
        lines += ["", "[lidar]", f"mount = {{ x = {x:.4f}, y = {y:.4f}, yaw = {_deg(yaw):.3f} }}"]
    return "\n".join(lines) + "\n"


def fit_drive(drive: Drive) -> WheelFit:
    """Wheels against laser over the whole drive; raises `DataInvalid`."""
    if len(drive.readings) < 2:
        raise DataInvalid(str(drive.path), "no odometry in it", "record with odometry.port set and readings sent to it")
    stamps, first = np.unique(drive.readings[:, 0], return_index=True)
    wheels = drive.readings[first, 1:].copy()
    wheels[:, 2] = np.unwrap(wheels[:, 2])
    laser_t = drive.poses.stamps
    inside = (laser_t >= stamps[0]) & (laser_t <= stamps[-1])
    said = np.column_stack([np.interp(laser_t[inside], stamps, wheels[:, k]) for k in range(3)])
    base, _ = poses_at(drive.poses, laser_t[inside])
    mount = np.array(drive.mount)
    try:
        return fit_wheels(said, on_base(base, mount), mount)
    except ValueError as error:
        raise DataInvalid(str(drive.path), str(error), "turn on the spot and drive some curves, both ways") from error


def _line(fit: WheelFit, which: Wheel) -> str:
    value, sigma = fit.value[which], fit.sigma[which]
    unit = {Wheel.DRIFT: " deg/m", Wheel.MOUNT_YAW: " deg", Wheel.MOUNT_X: " m", Wheel.MOUNT_Y: " m"}.get(which, "")
    if unit.startswith(" deg"):
        value, sigma = _deg(value), _deg(sigma)
    told = "" if fit.told[which] else "  not told by this drive"
    return f"{which.name.lower():<10} {value:>9.4f} +-{sigma:.4f}{unit}{told}"


def _deg(rad: float) -> float:
    return math.degrees(float(rad))
