"""Where the base is going: prediction from odometry, gyro or constant velocity, to the instant of each record.

Odometry says what happened up to its own stamp. When a scan is newer, the pose is carried ahead by the velocity, and
that carry (``ahead``) is taken back as soon as odometry for the same stretch arrives; so no motion is counted twice,
whatever the order and the quality of the stamps.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator import se2
from estimator.records import Array, Imu, Odometry

DOUBT_LEARNING, SURPRISE_CAP, DOUBT_CAP = 0.03, 10.0, 100.0
LONGEST_CARRY_S = 0.5
"""Beyond this a velocity says nothing any more; the pose is held and the uncertainty grows instead."""


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """One-sigma errors of a motion.

    Attributes:
        slip: of a travelled metre, m. skid: m of sideways error per radian turned. turn: rad per radian turned.
        drift: rad per metre travelled. floor_m, floor_rad: per prediction, encoder steps and stamp jitter.
        acceleration, angular_acceleration: what constant velocity does not know, m/s^2 and rad/s^2.
    """

    slip: float = 0.08
    skid: float = 0.03
    turn: float = 0.08
    drift: float = 0.02
    floor_m: float = 0.004
    floor_rad: float = 0.004
    acceleration: float = 1.5
    angular_acceleration: float = 4.0


@dataclass(slots=True, eq=False)
class Motion:
    """The moving pose.

    Attributes:
        t_mono: instant the pose is true for. T_odom_base: the pose.
        P: 3x3 covariance of the pose relative to the local map (odom-aligned axes).
        velocity: (v_x, v_y, yaw rate) in the base frame.
        ahead: motion already applied beyond the last odometry. odometry: whether any has arrived.
    """

    t_mono: float = -np.inf
    T_odom_base: Array = field(default_factory=se2.identity)
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    ahead: Array = field(default_factory=se2.identity)
    odometry: bool = False
    doubt: float = 1.0


def move(motion: Motion, delta: Array, Q: Array) -> None:
    """Move the pose by ``delta`` in the base frame, with noise ``Q`` (3x3, base-aligned)."""
    T = motion.T_odom_base
    motion.P = se2.carry(T, delta, motion.P)
    R = se2.rotation(T[2] + 0.5 * delta[2])
    motion.P += motion.doubt * (R @ Q @ R.T)
    motion.T_odom_base = se2.compose(T, delta)


def odometry_noise(delta: Array, noise: MotionNoise) -> Array:
    """Covariance of an odometry increment."""
    way, turned = float(np.hypot(delta[0], delta[1])), abs(float(delta[2]))
    along = noise.slip * way + noise.skid * turned
    yaw = noise.turn * turned + noise.drift * way
    return np.diag((along**2 + noise.floor_m**2, (0.5 * along) ** 2 + noise.floor_m**2, yaw**2 + noise.floor_rad**2))


def on_odometry(motion: Motion, record: Odometry, noise: MotionNoise) -> None:
    """Replace what was carried ahead by what the wheels say."""
    motion.odometry = True
    delta = se2.between(motion.ahead, record.delta)
    move(motion, delta, odometry_noise(record.delta, noise))
    dt = record.t_end - record.t_begin
    if dt > 1e-3:
        motion.velocity = se2.log(record.delta) / dt
    motion.ahead = se2.identity()
    motion.t_mono = max(motion.t_mono, record.t_end)


def on_imu(motion: Motion, record: Imu) -> None:
    """Turn rate from the gyro."""
    dt = record.t_end - record.t_begin
    if dt > 0.0 and np.isfinite(record.dyaw):
        motion.velocity = np.array((motion.velocity[0], motion.velocity[1], record.dyaw / dt))


def learn(motion: Motion, correction: Array, known: bool) -> float:
    """Learn from a match how far the prediction can be trusted; returns the factor by which this one's was too sure.

    Noise figures are those of a good robot. Where wheels slip or stamps jitter, matches keep correcting the prediction
    by more than its deviation says, and ``doubt`` scales the noise of the predictions to come.
    """
    surprise = float(correction @ se2.invert(motion.P) @ correction) / 3.0
    if known:
        seen = motion.doubt * min(surprise, SURPRISE_CAP)
        motion.doubt = min(max(1.0, motion.doubt + DOUBT_LEARNING * (seen - motion.doubt)), DOUBT_CAP)
    return max(1.0, surprise / 3.0)


def carry_to(motion: Motion, t_mono: float, noise: MotionNoise) -> None:
    """Bring the pose to ``t_mono`` at constant velocity."""
    dt = t_mono - motion.t_mono
    if not dt > 0.0:
        return
    if np.isfinite(dt):
        dt = min(dt, LONGEST_CARRY_S)
        delta = se2.exp(motion.velocity * dt)
        move(motion, delta, carry_noise(dt, noise))
        motion.ahead = se2.compose(motion.ahead, delta)
    motion.t_mono = t_mono


def carry_noise(dt: float, noise: MotionNoise) -> Array:
    """Covariance of a carry: unknown accelerations over ``dt``."""
    xy = noise.floor_m + noise.acceleration * dt * dt
    yaw = noise.floor_rad + noise.angular_acceleration * dt * dt
    return np.diag((xy**2, xy**2, yaw**2))
