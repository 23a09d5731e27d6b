"""Mount of a log's laser on its robot.

A laser line carries the poses of laser and robot in one frame. Their difference is the mount, equal on every line.
Where it varies, the first pose is a corrected pose and not wheel odometry; the log's parameters give the mount then.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.replay.carmen_lines import LaserLine
from hal.replay.report import LogReport

Array = npt.NDArray[np.float64]
Mount = tuple[float, float, float]

OFFSETS: Final = ("robot_frontlaser_offset", "robot_frontlaser_side_offset", "robot_frontlaser_angular_offset")
"""CARMEN's own parameters of the front laser's mount: m forward, m left, rad."""

_SAME_M: Final = 0.01
_SAME_RAD: Final = math.radians(0.5)
_MOST: Final = 0.99


def log_mount(lasers: list[LaserLine], parameters: dict[str, str], report: LogReport) -> Mount:
    """(x, y, yaw) of the laser on the robot in m and rad; ``report`` notes an uncertain one."""
    stated = _stated(parameters)
    measured = _differences(lasers)
    if len(measured) == 0:
        return stated or (0.0, 0.0, 0.0)
    middle = np.median(measured, axis=0)
    off = _outliers(measured, middle)
    if off.mean() > 1.0 - _MOST:
        report.notes.append(
            f"lidar and robot pose have no constant offset on {int(off.sum())} of {len(off)} lines: mount "
            f"{'from the parameters' if stated else 'taken as zero; set lidar.mount if it is not'}"
        )
        return stated or (0.0, 0.0, 0.0)
    if off.any():
        report.notes.append(f"lidar and robot pose disagree with the mount on {int(off.sum())} of {len(off)} lines")
    mount = _tidy(middle)
    if stated is not None and bool(_outliers(np.array([stated]), middle)[0]):
        report.notes.append(f"mount by the poses {mount}, by the parameters {stated}; the poses are used")
    return mount


def _stated(parameters: dict[str, str]) -> Mount | None:
    if OFFSETS[0] not in parameters:
        return None
    try:
        x, y, yaw = (float(parameters.get(name, "0") or "0") for name in OFFSETS)
    except ValueError:
        return None
    return (x, y, yaw) if all(map(math.isfinite, (x, y, yaw))) else None


def _differences(lasers: list[LaserLine]) -> Array:
    """The laser's pose in the robot's frame for each line that has both: (n, 3)."""
    pairs = [(line.robot, line.laser) for line in lasers if line.robot is not None and line.laser is not None]
    both = np.array(pairs, dtype=np.float64).reshape(-1, 2, 3)
    robot, delta = both[:, 0], both[:, 1] - both[:, 0]
    cos, sin = np.cos(robot[:, 2]), np.sin(robot[:, 2])
    x, y = cos * delta[:, 0] + sin * delta[:, 1], cos * delta[:, 1] - sin * delta[:, 0]
    return np.stack([x, y, np.mod(delta[:, 2] + math.pi, 2.0 * math.pi) - math.pi], axis=1)


def _outliers(measured: Array, middle: Array) -> npt.NDArray[np.bool_]:
    off = measured - middle
    turn = np.mod(off[:, 2] + math.pi, 2.0 * math.pi) - math.pi
    return (np.hypot(off[:, 0], off[:, 1]) > _SAME_M) | (np.abs(turn) > _SAME_RAD)


def _tidy(middle: Array) -> Mount:
    """Round to 10 um and 10 urad, the accuracy of six written decimals, without a negative zero."""
    x, y, yaw = (round(float(value), 5) + 0.0 for value in middle)
    return x, y, yaw
