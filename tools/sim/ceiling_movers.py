"""What moves between robot and lamps: people as upright cylinders, and the sway of the robot's own body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.people import Crowd, Walker
from tools.sim.robot import Drive

Array = npt.NDArray[np.float64]

SHOULDERS_M: Final = 0.22
"""Radius of a person."""
HEAD_M: Final = 1.75


def rows_of(bodies: Array) -> Array:
    """(k, 8) obstacle rows of people who stand at (k, 2) places."""
    rows = np.zeros((len(bodies), 8))
    rows[:, 0], rows[:, 1:3], rows[:, 3], rows[:, 6] = 1.0, bodies, SHOULDERS_M, HEAD_M
    return rows


def walkers_of(walkers: tuple[Walker, ...], since: float = 0.0) -> Callable[[Array, Array], Array]:
    """Obstacle rows of walkers at (n,) times, who began to walk at ``since`` and avoid the robot at (n, 3) poses."""
    crowd = Crowd(walkers)

    def rows(t: Array, poses: Array) -> Array:
        made = [rows_of(crowd.bodies(float(now) - since, pose)) for now, pose in zip(t, poses, strict=True)]
        return np.array(made).reshape(len(t), len(walkers), 8)

    return rows


def lean_of(drive: Drive, since: float = 0.0) -> Callable[[Array], Array]:
    """Pitch and roll (n, 2) of a drive's robot at (n,) times, less the constant tilt of its lidar's mount."""
    level = drive.body.tilt

    def lean(t: Array) -> Array:
        made = np.array([drive.tilt(float(now) - since) for now in t])
        return np.column_stack([made[:, 0] - level, made[:, 1]])

    return lean
