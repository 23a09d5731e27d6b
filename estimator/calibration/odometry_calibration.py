"""Odometry and lidar mount calibration from one drive: wheel odometry compared with lidar poses.

The lidar moves as X^-1 W X: W is the motion of the base by odometry, X the pose of the lidar on the base (simultaneous
calibration; A. Censi et al., IEEE Trans. Robotics 29, 2013). Odometry errors are a scale of distance, a scale of turns
(their track: turns are measured over it) and a turn per metre (wheels of unequal size).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from estimator.numerics.arrays import Array

STEP_M: Final = 0.4
"""Distance of one step, m."""
STEP_RAD: Final = 0.35
"""Turn of one step, rad."""
FEWEST: Final = 12
"""Steps without which nothing is fitted."""
NOISE: Final = (0.01, 0.01, 0.006)
"""Initial sigma of a step (m, m, rad); later rounds take it from the residuals."""
PRIOR: Final = (0.1, 0.15, 0.05, 0.15, 0.15, 0.15)
"""Prior sigmas, in the order of :class:`Wheel`."""
TOLD: Final = 0.5
"""The drive determines a parameter if it reduces the sigma below this share of the prior sigma."""


class Wheel(IntEnum):
    """Parameters of :class:`WheelFit`."""

    SCALE = 0  # of distances
    TURN = 1  # of turns
    DRIFT = 2  # rad per m
    MOUNT_X = 3  # lidar in base_link, m
    MOUNT_Y = 4
    MOUNT_YAW = 5  # rad


@dataclass(frozen=True, slots=True, eq=False)
class WheelFit:
    """Result of the odometry calibration.

    Attributes:
        value, sigma: (6,) by :class:`Wheel`. told: (6,) whether the drive determined the parameter.
        before, after: RMS of the step residuals, (m, rad) each. steps: number of steps.
        off_before, off_after: (k, 3) odometry minus lidar of each step, x, y in m and yaw in rad, in the lidar's frame.
    """

    value: Array
    sigma: Array
    told: tuple[bool, ...]
    before: tuple[float, float]
    after: tuple[float, float]
    steps: int
    off_before: Array
    off_after: Array


def fit_wheels(odometry: Array, laser: Array, mount: Array) -> WheelFit:
    """Fit odometry scales and lidar mount.

    Args:
        odometry: (n, 3) poses by odometry.
        laser: (n, 3) poses of the lidar in its map, at the same instants.
        mount: (3,) x, y, yaw of the lidar on the base as configured.

    Raises:
        ValueError: too little motion; the message gives the number of steps.
    """
    from scipy.optimize import least_squares

    W, L = _steps(odometry, laser)
    if len(W) < FEWEST:
        raise ValueError(
            f"only {len(W)} steps of {STEP_M} m or {STEP_RAD} rad; at least {FEWEST} are needed, so drive farther"
        )
    begin = np.array((1.0, 1.0, 0.0, *mount))
    weight = 1.0 / np.array(NOISE)
    prior = np.array(PRIOR)

    def cost(p: Array) -> Array:
        """Weighted residuals of all steps, and of the priors."""
        steps = _residuals(p, W, L) * weight
        return np.concatenate((steps.ravel(), (p - begin) / prior))

    for _ in range(3):
        found = least_squares(cost, begin, loss="soft_l1", x_scale=prior)
        spread = 1.4826 * np.median(np.abs(_residuals(found.x, W, L)), axis=0)
        weight = 1.0 / np.maximum(spread, (1e-4, 1e-4, 1e-4))
    J = np.asarray(found.jac, dtype=np.float64)
    sigma = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    off = _residuals(begin, W, L), _residuals(found.x, W, L)
    return WheelFit(
        np.asarray(found.x), sigma, tuple((sigma < TOLD * prior).tolist()), _rms(off[0]), _rms(off[1]), len(W), *off
    )  # fmt: skip


def _steps(odometry: Array, laser: Array) -> tuple[Array, Array]:
    """Relative motions (k, 3) of odometry and lidar between instants one step apart."""
    at = [0]
    for i in range(1, len(odometry)):
        last = odometry[at[-1]]
        moved = np.hypot(odometry[i, 0] - last[0], odometry[i, 1] - last[1])
        if moved >= STEP_M or abs(odometry[i, 2] - last[2]) >= STEP_RAD:
            at.append(i)
    return _between(odometry[at[:-1]], odometry[at[1:]]), _between(laser[at[:-1]], laser[at[1:]])


def _residuals(p: Array, W: Array, L: Array) -> Array:
    """(k, 3) motion of the lidar predicted from odometry and mount, minus the measured one."""
    way = np.hypot(W[:, 0], W[:, 1]) * np.sign(W[:, 0])
    yaw = p[Wheel.TURN] * W[:, 2] + p[Wheel.DRIFT] * way
    half = 0.5 * (yaw - W[:, 2])
    c, s = np.cos(half), np.sin(half)
    moved = p[Wheel.SCALE] * np.column_stack((c * W[:, 0] - s * W[:, 1], s * W[:, 0] + c * W[:, 1]))
    X = np.tile(p[Wheel.MOUNT_X :], (len(W), 1))
    end = _compose(np.column_stack((moved, yaw)), X)
    said = _between(X, end)
    off = said - L
    off[:, 2] = (off[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return off


def _between(a: Array, b: Array) -> Array:
    """(k, 3) pose of b relative to a."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    turn = (b[:, 2] - a[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.column_stack((c * dx + s * dy, c * dy - s * dx, turn))


def _compose(a: Array, b: Array) -> Array:
    """(k, 3) composition of a and b."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        (a[:, 0] + c * b[:, 0] - s * b[:, 1], a[:, 1] + s * b[:, 0] + c * b[:, 1], a[:, 2] + b[:, 2])
    )


def on_base(poses: Array, mount: Array) -> Array:
    """(n, 3) poses of the lidar, from poses of the base and the mount that these were computed with."""
    return _compose(poses, np.tile(mount, (len(poses), 1)))


def _rms(off: Array) -> tuple[float, float]:
    """RMS of the residuals: position (m), yaw (rad)."""
    return float(np.sqrt(np.mean(off[:, :2] ** 2))), float(np.sqrt(np.mean(off[:, 2] ** 2)))
