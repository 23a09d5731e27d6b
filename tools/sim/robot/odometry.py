"""Wheel encoders with wrong radii and wheel base, ticks, noise and slip, dead-reckoned like a motor controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from tools.sim.robot.drive import Array, Drive

_BLOCK: Final = 512


class Ground(Protocol):
    """The ground on which wheels slip."""

    def polished_at(self, points: Array) -> npt.NDArray[np.bool_]:
        """Whether each point (n, 2) in m lies on a polished part."""


@dataclass(frozen=True, slots=True)
class Wheels:
    """Errors of wheel odometry.

    Attributes:
        rate_hz: readings per second. tick_m: wheel travel per encoder tick.
        scale: one-sigma relative error of each wheel's radius. base_scale: the same of the wheel base.
        noise: one-sigma of a wheel's travel error in m per square root of m.
        slips_per_m: slip events per metre on a matt floor. polish: how many times more there are on a polished one.
        slip_m: mean size of a slip event (exponential); three of four are spins (too much measured), the rest skids.
    """

    rate_hz: float = 50.0
    tick_m: float = 0.0002
    scale: float = 0.004
    base_scale: float = 0.008
    noise: float = 0.003
    slips_per_m: float = 0.05
    polish: float = 4.0
    slip_m: float = 0.008


class Odometer:
    """Cumulative odometry readings of one drive, reading ``k`` true at ``k / rate_hz``; same seed, same slip."""

    def __init__(self, drive: Drive, ground: Ground, wheels: Wheels, seed: int = 0) -> None:
        self.wheels = wheels
        self._drive, self._ground, self._seed = drive, ground, seed
        rng = np.random.default_rng((seed, 0))
        self.scale = 1.0 + wheels.scale * rng.standard_normal(2)
        self.base = drive.body.wheel_base * (1.0 + wheels.base_scale * rng.standard_normal())
        self._travel = np.zeros(2)
        self._pose = np.zeros(3)
        self._block = -1
        self._poses = np.zeros((1, 3))

    def reading(self, k: int) -> Array:
        """Pose (x, y, yaw unwrapped) since the start. Readings may skip ahead but not go back a block."""
        while self._block < k // _BLOCK:
            self._block += 1
            self._poses = self._next_block()
        if k // _BLOCK != self._block:
            raise ValueError(f"odometry reading {k} is past: readings are made in order")
        return np.asarray(self._poses[k % _BLOCK])

    def _next_block(self) -> Array:
        """Poses of one block; the step that leads to reading k belongs to k's block."""
        first = self._block * _BLOCK
        t = (np.arange(first, first + _BLOCK + 1) - 1) / self.wheels.rate_hz
        true = self._drive.pose(t)
        ds = np.diff(self._drive.travelled(t))
        dyaw = np.diff(true[:, 2])
        half = 0.5 * self._drive.body.wheel_base
        moved = np.column_stack([ds - half * dyaw, ds + half * dyaw])
        measured = moved * self.scale + self._errors(moved, ds, true[1:, :2])
        travel = self._travel + np.cumsum(measured, axis=0)
        ticks = np.floor(np.vstack([self._travel, travel]) / self.wheels.tick_m) * self.wheels.tick_m
        self._travel = travel[-1]
        poses = self._dead_reckon(np.diff(ticks, axis=0))
        self._pose = poses[-1]
        return poses

    def _errors(self, moved: Array, ds: Array, at: Array) -> Array:
        wheels = self.wheels
        rng = np.random.default_rng((self._seed, 1 + self._block))
        errors = wheels.noise * np.sqrt(np.abs(moved)) * rng.standard_normal(moved.shape)
        rate = wheels.slips_per_m * np.where(self._ground.polished_at(at), wheels.polish, 1.0)
        slips = rng.random(len(ds)) < rate * ds
        size = rng.exponential(wheels.slip_m, len(ds)) * np.where(rng.random(len(ds)) < 0.75, 1.0, -1.0)
        side = rng.integers(0, 2, len(ds))
        rows = np.flatnonzero(slips)
        errors[rows, side[rows]] += size[rows]
        return errors

    def _dead_reckon(self, step: Array) -> Array:
        forward = 0.5 * (step[:, 0] + step[:, 1])
        dyaw = (step[:, 1] - step[:, 0]) / self.base
        yaw = self._pose[2] + np.cumsum(dyaw)
        middle = yaw - 0.5 * dyaw
        x = self._pose[0] + np.cumsum(forward * np.cos(middle))
        y = self._pose[1] + np.cumsum(forward * np.sin(middle))
        return np.column_stack([x, y, yaw])
