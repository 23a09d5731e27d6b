"""What moves between robot and lamps: people as upright cylinders, and the sway of the robot's own body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.building.people import Crowd, Walker
from tools.sim.robot.drive import Drive, leans

Array = npt.NDArray[np.float64]

SHOULDERS_M: Final = 0.22
"""Radius of a person."""
HEAD_M: Final = 1.75


def rows_of(bodies: Array) -> Array:
    """(n, k, 8) obstacle rows of people who stand at (n, k, 2) places."""
    rows = np.zeros((*bodies.shape[:2], 8))
    rows[..., 0], rows[..., 1:3], rows[..., 3], rows[..., 6] = 1.0, bodies, SHOULDERS_M, HEAD_M
    return rows


def walkers_of(walkers: tuple[Walker, ...]) -> Callable[[Array, Array], Array]:
    """Obstacle rows of walkers at (n,) times, who began to walk at time 0 and avoid the robot at (n, 3) poses."""
    crowd = Crowd(walkers)
    return lambda t, poses: rows_of(crowd.bodies(t, poses))


def lean_of(drive: Drive) -> Callable[[Array], Array]:
    """Pitch and roll (n, 2) of a drive's robot at (n,) times, less the constant tilt of its lidar's mount."""
    return lambda t: leans(drive, t)
