"""The diffuse floor: what a room's surfaces give back after many reflections, uneven and leaking through its doors."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.ceiling.lamps import Zone

Array = npt.NDArray[np.float64]

LEAK_M: Final = 1.5
"""Outside its room a lamp's diffuse light falls by e in this distance."""
CARRY: Final = 2.5
"""Inside, it falls by e in so many times the room's narrow side: evenly spread in a room, not along a corridor."""


def carried(at: Array, lamp: Array, zone: Zone) -> Array:
    """How much of a lamp's diffuse light gets to (n, 2) points, 1 beside it."""
    x_min, y_min, x_max, y_max = zone
    far = np.hypot(*(at - lamp).T) / (CARRY * min(x_max - x_min, y_max - y_min))
    return np.asarray(np.exp(-outside(at, zone) / LEAK_M - far))


def within(at: Array, zone: Zone) -> npt.NDArray[np.bool_]:
    """Which of (n, 2) points lie in a zone."""
    x_min, y_min, x_max, y_max = zone
    return np.asarray((at[:, 0] >= x_min) & (at[:, 0] <= x_max) & (at[:, 1] >= y_min) & (at[:, 1] <= y_max))


def outside(at: Array, zone: Zone) -> Array:
    """Distance of (n, 2) points from a zone, 0 inside."""
    x_min, y_min, x_max, y_max = zone
    dx = np.maximum(np.maximum(x_min - at[:, 0], at[:, 0] - x_max), 0.0)
    dy = np.maximum(np.maximum(y_min - at[:, 1], at[:, 1] - y_max), 0.0)
    return np.asarray(np.hypot(dx, dy))


def waves(rng: np.random.Generator) -> Array:
    """Rows kx, ky, phase of five waves 4 to 10 m long."""
    angle, length = rng.uniform(0.0, 2.0 * np.pi, 5), rng.uniform(4.0, 10.0, 5)
    k = 2.0 * np.pi / length
    return np.column_stack([k * np.cos(angle), k * np.sin(angle), rng.uniform(0.0, 2.0 * np.pi, 5)])


def own_wave(normal: Array) -> Array:
    """One wave of a lamp's own, some 6 m long."""
    k = 2.0 * np.pi / (6.0 + np.tanh(normal[0]))
    angle = np.pi * normal[1]
    return np.array([[k * np.cos(angle), k * np.sin(angle), np.pi * normal[2]]])


def pattern(at: Array, rows: Array) -> Array:
    """Sum of waves, about -1 to 1."""
    phase = at[:, :1] * rows[:, 0] + at[:, 1:2] * rows[:, 1] + rows[:, 2]
    return np.asarray(np.sin(phase).sum(axis=1) / np.sqrt(len(rows)))
