"""People who walk: two legs each, swinging, along a path there and back; they step aside for the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tools.sim.building.world import CIRCLE, MATERIAL_ID, Array

LEG_RADIUS_M: Final = 0.075
STANCE_M: Final = 0.09  # half the distance between the feet, sideways
SWING_M: Final = 0.28  # how far a foot gets ahead of the hip
STRIDE_M: Final = 1.4  # two steps
KEEP_AWAY_M: Final = 0.8
_AHEAD_S: Final = 0.02  # for the legs' velocities


@dataclass(frozen=True, slots=True)
class Walker:
    """A person walking up and down a polyline of (n, 2) points at ``speed`` m/s, starting ``offset_m`` along it."""

    path: tuple[tuple[float, float], ...]
    speed: float = 1.2
    offset_m: float = 0.0
    material: str = "cloth"


class Crowd:
    """All walkers of a scene; where their legs are is a function of time (and of the robot they avoid)."""

    def __init__(self, walkers: tuple[Walker, ...]) -> None:
        self._walkers = walkers
        self._paths = [np.array(walker.path, dtype=float) for walker in walkers]
        self._lengths = [np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))]) for path in self._paths]

    def legs(self, t: float, robot: Array) -> Array:
        """Rows ``1, x, y, r, material, vx, vy`` (m, m/s), two per person, true at ``t``; ``robot`` is (x, y, ...)."""
        rows = np.zeros((2 * len(self._walkers), 7))
        for number in range(len(self._walkers)):
            rows[2 * number : 2 * number + 2] = self._person(number, t, robot)
        return rows

    def bodies(self, t: Array, robot: Array) -> Array:
        """(n, people, 2) where people stand, midway between their feet, at (n,) times; ``robot`` is (n, 3)."""
        places = np.zeros((len(t), len(self._walkers), 2))
        for number, (walker, path, length) in enumerate(zip(self._walkers, self._paths, self._lengths, strict=True)):
            walked = walker.offset_m + walker.speed * t
            folded = np.abs((walked + length[-1]) % (2 * length[-1]) - length[-1])
            x, y = np.interp(folded, length, path[:, 0]), np.interp(folded, length, path[:, 1])
            places[:, number] = np.column_stack(_step_aside(x, y, robot.T))
        return places

    def _person(self, number: int, t: float, robot: Array) -> Array:
        walker, path, length = self._walkers[number], self._paths[number], self._lengths[number]
        walked = walker.offset_m + walker.speed * np.array([t, t + _AHEAD_S])
        folded = np.abs((walked + length[-1]) % (2 * length[-1]) - length[-1])
        x, y = np.interp(folded, length, path[:, 0]), np.interp(folded, length, path[:, 1])
        leg = int(np.clip(np.searchsorted(length, folded[0], side="right") - 1, 0, len(path) - 2))
        along = (path[leg + 1] - path[leg]) / max(length[leg + 1] - length[leg], 1e-9)
        swing = SWING_M * np.sin(2 * np.pi * walked / STRIDE_M)
        x, y = _step_aside(x, y, robot)
        rows = np.empty((2, 7))
        for row, side in zip(rows, (1.0, -1.0), strict=True):
            foot_x = x + side * (swing * along[0] - STANCE_M * along[1])
            foot_y = y + side * (swing * along[1] + STANCE_M * along[0])
            row[:5] = CIRCLE, foot_x[0], foot_y[0], LEG_RADIUS_M, MATERIAL_ID[walker.material]
            row[5:] = (foot_x[1] - foot_x[0]) / _AHEAD_S, (foot_y[1] - foot_y[0]) / _AHEAD_S
        return rows


def _step_aside(x: Array, y: Array, robot: Array) -> tuple[Array, Array]:
    """Push a person out of the robot's way, along the line between them."""
    dx, dy = x - robot[0], y - robot[1]
    distance = np.maximum(np.hypot(dx, dy), 1e-6)
    push = np.maximum(KEEP_AWAY_M - distance, 0.0) / distance
    return x + push * dx, y + push * dy
