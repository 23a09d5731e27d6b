"""Motion model: predicts the pose from odometry, gyro or constant velocity to the instant of each record.

Odometry describes the motion up to its own stamp. For a newer scan the velocity extrapolates the pose. That
extrapolation (``ahead``) is subtracted when odometry for the same interval arrives. So no motion is counted twice,
whatever the order and the quality of the stamps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimator.fusion.motion_history import Trail
from estimator.measurements import Imu, Odometry
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import carry_on, feel_axes
from estimator.numerics.symmetric3 import invert3

LONGEST_CARRY_S = 0.5
"""Longest extrapolation, s; then the pose is kept constant and only its covariance grows."""

UNSEEN = np.array((0.5, 0.5, 0.5))
"""One-sigma speed (m/s, m/s, rad/s) of a robot without data: it may be pushed, or continue at walking speed."""
LARGEST_TURN = math.pi
"""Sigma of an unknown heading, rad."""
STILL_M, STILL_RAD = 0.03, 0.02
"""Distance from the rest pose within which the robot is at rest (m, rad): the noise of good matches."""
STARTS_S = 0.2
"""Time (s) for which a robot at rest is modelled as starting, like a moving one.

A scan of a robot that starts, or the first after a lost scan, must not exceed the covariance.
"""

DYING = 0.8
"""Factor on an unconfirmed velocity after each scan."""

GYRO_RAD = 5e-4
"""Error (rad) of a gyro increment: rate noise and bias of a consumer MEMS gyro over some 10 ms."""
BIAS_LEARNING = 0.02
"""Share of the difference to a match's rotation that updates the gyro bias, per 0.1 s."""
GYRO_GATE = 5.0
"""Gate on a gyro rate, in sigma: beyond it units are wrong, or the gyro is damaged. No robot accelerates like that."""

DOUBT_LEARNING, SURPRISE_CAP, DOUBT_CAP = 0.03, 10.0, 100.0
DOUBT_LEAST = 1.0
"""Smallest noise factor: odometry that has long been good may slip at any time, so the stated noise is the minimum."""
LEAST_EXPECTED = 0.3
"""Smallest expected squared correction; a match with less than a tenth of the possible one is hardly informative."""


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """One-sigma errors of a motion.

    Attributes:
        slip: error per metre travelled, m.
        skid: sideways error per radian turned, m.
        turn: rad per radian turned.
        drift: rad per metre travelled.
        floor_m, floor_rad: random walk of odometry over 0.2 s (encoder steps, stamp jitter).
        acceleration, angular_acceleration: unknown acceleration at constant velocity, m/s^2 and rad/s^2.
    """

    slip: float = 0.08
    skid: float = 0.03
    turn: float = 0.08
    drift: float = 0.02
    floor_m: float = 0.004
    floor_rad: float = 0.004
    acceleration: float = 1.0
    angular_acceleration: float = 2.0

    def acceleration_variance(self) -> Array:
        """Variance of the acceleration (x, y, yaw)."""
        return np.array((self.acceleration**2, self.acceleration**2, self.angular_acceleration**2))


@dataclass(slots=True)
class Gyro:
    """Sums of gyro rotation (rad) and time (s) since the last odometry and the last match, and the learned bias."""

    turned_rad: float = 0.0
    span_s: float = 0.0
    match_turned_rad: float = 0.0
    match_span_s: float = 0.0
    bias_rad_s: float = 0.0

    def add(self, turn: float, dt: float) -> None:
        """Add a reading, bias already subtracted."""
        self.turned_rad += turn
        self.span_s += dt
        self.match_turned_rad += turn
        self.match_span_s += dt

    def learn(self, turned_rad: float, dt: float) -> None:
        """Learn the bias from the rotation between two matches ``dt`` apart, if readings covered that interval."""
        span, said = self.match_span_s, self.match_turned_rad
        self.match_turned_rad = self.match_span_s = 0.0
        if dt > 0.0 and abs(span - dt) < 0.3 * dt:
            self.bias_rad_s += BIAS_LEARNING * min(1.0, dt / 0.1) * (said * dt / span - turned_rad) / dt


@dataclass(slots=True, eq=False)
class Motion:
    """The moving pose and its covariance: the predicted half of a filter.

    Attributes:
        t_mono: instant of the pose.
        T_odom_base: the pose.
        P: 3x3 covariance of the pose relative to the local map (odom-aligned axes).
        velocity, velocity_variance: (v_x, v_y, yaw rate) in the base frame.
        t_felt: instant up to which the velocity's variance has grown.
        t_gyro: end of the latest accepted gyro reading.
        t_told: instant of the latest match or odometry; since then the velocity extrapolates the pose.
        T_stood, t_stood: present or latest rest pose, and the instant it began; infinite without data.
        ahead: extrapolation beyond the last odometry.
        odometry: whether any odometry has arrived.
        t_odometry: its end.
        doubt: learned factor on the noise's variance.
        gyro: sums and bias.
        trail: the motion of the last two seconds.
    """

    t_mono: float = -math.inf
    T_odom_base: Array = field(default_factory=se2.identity)
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    velocity_variance: Array = field(default_factory=lambda: np.ones(3))
    t_felt: float = -math.inf
    t_gyro: float = -math.inf
    t_told: float = -math.inf
    T_stood: Array = field(default_factory=se2.identity)
    t_stood: float = math.inf
    ahead: Array = field(default_factory=se2.identity)
    odometry: bool = False
    t_odometry: float = -math.inf
    doubt: float = 1.0
    gyro: Gyro = field(default_factory=Gyro)
    trail: Trail = field(default_factory=Trail)


def move(motion: Motion, delta: Array, variance: Array) -> None:
    """Move the pose by ``delta`` in the base frame, with noise of ``variance`` (x, y, yaw; base-aligned)."""
    T, P = np.empty(3), np.empty((3, 3))  # others may hold a reference to the previous pose
    carry_on(motion.T_odom_base, delta, variance, motion.P, T, P)
    motion.T_odom_base, motion.P = T, P


def on_odometry(motion: Motion, record: Odometry, noise: MotionNoise) -> None:
    """Replace the extrapolation by odometry, and its rotation by the gyro's where that covers the interval.

    A non-finite increment is ignored.
    Only an increment that continues the last one covers the interval of the extrapolation. One after a gap, or from a
    sender switched on late, adds only its part after the present instant. Until then other data has kept the pose.
    """
    if not all(map(math.isfinite, record.delta.tolist())):
        return
    dt = record.t_end - record.t_begin
    delta = np.array(record.delta, dtype=np.float64)  # a kernel takes no view of another array
    variance = odometry_variance(delta, dt, noise)
    if dt > 0.0 and abs(motion.gyro.span_s - dt) < 0.3 * dt:
        delta = np.array((delta[0], delta[1], motion.gyro.turned_rad * dt / motion.gyro.span_s))
        variance[2] = min(float(variance[2]), GYRO_RAD**2)
    variance *= motion.doubt
    motion.gyro.turned_rad = motion.gyro.span_s = 0.0
    follows = abs(record.t_begin - motion.t_odometry) < 1e-6 and dt < LONGEST_CARRY_S
    made = se2.between(motion.ahead, delta) if follows else record.part_after(motion.t_mono, delta)
    move(motion, made, variance)
    if follows:
        motion.trail.take_back(record.t_begin)
        motion.trail.add(record.t_begin, record.t_end, delta, variance)
    else:
        motion.trail.add(max(motion.t_mono, record.t_begin), record.t_end, made, variance)
    feel(motion, delta, (record.t_begin, record.t_end), variance, noise)
    motion.ahead, motion.odometry, motion.t_odometry = se2.identity(), True, record.t_end
    motion.t_mono = max(motion.t_mono, record.t_end)


def odometry_variance(delta: Array, dt: float, noise: MotionNoise) -> Array:
    """Variance (x, y, yaw; m^2, m^2, rad^2) of an odometry increment over ``dt`` seconds."""
    x, y, yaw = delta.tolist()
    way, turned, share = math.hypot(x, y), abs(yaw), min(1.0, max(dt, 0.02) / 0.2)
    along = noise.slip * way + noise.skid * turned
    heading = noise.turn * turned + noise.drift * way
    floor = share * noise.floor_m**2
    return np.array((along**2 + floor, 0.25 * along**2 + floor, heading**2 + share * noise.floor_rad**2))


def feel(motion: Motion, delta: Array, interval: tuple[float, float], variance: Array, noise: MotionNoise) -> None:
    """Update the velocity by a motion ``delta`` over an interval: a scalar Kalman filter for each component.

    A mean over the interval serves as the value at its end. That adds unknown acceleration over half the interval.
    """
    begin, end = interval
    motion.t_told = max(motion.t_told, end)
    stir(motion, end)
    dt = end - begin
    if not 1e-3 < dt < LONGEST_CARRY_S:
        return
    late = min(max(0.0, end - motion.t_felt), LONGEST_CARRY_S)
    spread, unknown = motion.velocity_variance, noise.acceleration_variance()
    feel_axes(motion.velocity, spread, se2.log(delta), variance, unknown, (dt, late))
    motion.t_felt = max(motion.t_felt, end)


def on_imu(motion: Motion, record: Imu, noise: MotionNoise) -> None:
    """Rotate by the gyro increment over its interval, without the bias, and extrapolate at the velocity.

    A rate that the robot cannot have reached since the last known rate is ignored. With the gyro's small variance it
    would move the pose to where no scan fits. The local map would then restart.
    """
    dt = record.t_end - record.t_begin
    if not (0.0 < dt < LONGEST_CARRY_S and math.isfinite(record.dyaw)):
        return
    carry_to(motion, record.t_begin, noise)
    rate, variance = record.dyaw / dt - motion.gyro.bias_rad_s, (GYRO_RAD / dt) ** 2
    late = min(max(0.0, record.t_end - max(motion.t_felt, motion.t_gyro)), LONGEST_CARRY_S)
    expected = float(motion.velocity_variance[2]) + (noise.angular_acceleration * late) ** 2 + variance
    if (rate - float(motion.velocity[2])) ** 2 <= GYRO_GATE**2 * expected:
        motion.velocity = np.array((motion.velocity[0], motion.velocity[1], rate))
        motion.velocity_variance[2] = variance
        motion.t_gyro = record.t_end
        motion.gyro.add(rate * dt, dt)
    carry_to(motion, record.t_end, noise)
    stir(motion, record.t_end)


def carry_to(motion: Motion, t_mono: float, noise: MotionNoise) -> None:
    """Predict the pose to ``t_mono`` at constant velocity; an instant in the past changes nothing.

    After :data:`LONGEST_CARRY_S` without match or odometry, the pose stays constant, whatever other records arrive.
    """
    dt = t_mono - motion.t_mono
    if not dt > 0.0:
        return
    if math.isfinite(dt):
        before = untold(motion)
        carried = [min(t + dt, LONGEST_CARRY_S) - min(t, LONGEST_CARRY_S) for t in before]
        delta = se2.exp(motion.velocity * carried)
        variance = carried_variance(motion, before, dt, noise)
        move(motion, delta, variance)
        motion.trail.add(motion.t_mono, t_mono, delta, variance)
        if dt > LONGEST_CARRY_S:
            motion.trail.forget(t_mono)
        motion.ahead = se2.compose(motion.ahead, delta)
    motion.t_mono = t_mono


def stir(motion: Motion, t_mono: float) -> None:
    """Update the rest pose: a robot away from it has moved, and can be at rest here at best."""
    x, y, yaw = se2.between(motion.T_stood, motion.T_odom_base).tolist()
    if not (motion.t_stood <= t_mono and math.hypot(x, y) < STILL_M and abs(yaw) < STILL_RAD):
        motion.T_stood, motion.t_stood = motion.T_odom_base.copy(), t_mono


def slow_down(motion: Motion) -> None:
    """Reduce an unconfirmed velocity; the reduction of its square is added to its variance."""
    square = motion.velocity * motion.velocity
    motion.velocity = DYING * motion.velocity
    motion.velocity_variance = motion.velocity_variance + (1.0 - DYING * DYING) * square


def untold(motion: Motion) -> tuple[float, float, float]:
    """Time (s) without a measurement of the position (x, y) and of the heading; 0 before the first one."""
    place = motion.t_mono - motion.t_told
    heading = motion.t_mono - max(motion.t_told, motion.t_gyro)
    place, heading = (max(0.0, t) if math.isfinite(t) else 0.0 for t in (place, heading))
    return place, place, heading


def carried_variance(motion: Motion, before: tuple[float, float, float], dt: float, noise: MotionNoise) -> Array:
    """Variance (x, y, yaw) added by an extrapolation of ``dt`` seconds, after extrapolation for ``before`` already.

    The velocity error stays the same from one extrapolation to the next, so errors add up, not variances. Light epochs
    between two scans give no new information about the motion. Only a gyro measures the rotation again. The result is
    the accumulated value at the end minus that at the begin, independent of how time is divided.
    """
    stood = max(0.0, motion.t_told - motion.t_stood)
    spread, unknown = (
        motion.velocity_variance.tolist(),
        (noise.acceleration, noise.acceleration, noise.angular_acceleration),
    )
    added = []
    for axis, t in enumerate(before):
        grown = carried_square(t + dt, unknown[axis], axis, stood, motion.doubt)
        grown -= carried_square(t, unknown[axis], axis, stood, motion.doubt)
        t0, t1 = min(t, LONGEST_CARRY_S), min(t + dt, LONGEST_CARRY_S)
        added.append(motion.doubt * spread[axis] * (t1 * t1 - t0 * t0) + grown)
    added[2] = min(added[2], max(0.0, LARGEST_TURN**2 - float(motion.P[2, 2])))
    return np.array(added)


def carried_square(t: float, acceleration: float, axis: int, stood: float, doubt: float) -> float:
    """Variance of the displacement along an axis from the extrapolation by a velocity ``t`` seconds old.

    The velocity changes by the unknown acceleration, limited by the speed of a robot without data. After
    :data:`LONGEST_CARRY_S` the pose stays constant, and the whole velocity is its error. A robot at rest for ``stood``
    seconds stays at rest for another ``t`` with probability ``stood / (stood + t)``. Only its past duration predicts
    the length of a rest. If the robot starts, every instant is equally likely, which makes the square of its path a
    third.
    """
    speed = float(UNSEEN[axis])

    def square(t: float) -> float:
        carried = min(t, LONGEST_CARRY_S)
        way = min(acceleration * carried, speed) * carried
        return doubt * way * way + (speed * (t - carried)) ** 2

    if t <= STARTS_S or stood <= 0.0:
        return square(t)
    return max(square(STARTS_S), square(t) * t / (t + 3.0 * stood))


def learn(motion: Motion, correction: Array, H: Array, known: bool) -> Array:
    """Learn the noise factor from a match; returns the covariance (3, 3) that this prediction lacked.

    The noise figures describe a good robot. Where wheels slip or stamps jitter, corrections exceed the prediction's
    sigma, and ``doubt`` scales the noise of later predictions. A match with information ``H`` (3, 3) corrects the share
    ``(L + H)^-1 H`` of the prediction's variance. That is the expected square of the correction. For a correction
    beyond three sigma, the returned covariance reduces it to three sigma along its own direction only. Across it
    nothing was wrong. Otherwise each large correction would enlarge the covariance of a degenerate direction without
    limit.
    """
    L = invert3(motion.P)
    square = float(correction @ L @ correction)
    if known:
        expected = float((invert3(L + H) * H).sum())  # trace of the product of two symmetric matrices
        seen = motion.doubt * min(square / max(expected, LEAST_EXPECTED), SURPRISE_CAP)
        motion.doubt = min(max(DOUBT_LEAST, motion.doubt + DOUBT_LEARNING * (seen - motion.doubt)), DOUBT_CAP)
    return max(0.0, 1.0 / 9.0 - 1.0 / max(square, 9.0)) * np.outer(correction, correction)


FASTEST = (1.0, 2.0)
"""Largest speed above that of odometry or velocity, m/s and rad/s; wheels slip in turns, and stamps come late."""
MARGIN_M, MARGIN_RAD = 0.4, 0.2
"""Additional displacement allowed, m and rad: matches of one position differ by less."""


def too_far(moved: Array, dt: float) -> bool:
    """Whether a pose has moved (x, y, yaw) farther than a robot can drive in ``dt`` seconds."""
    x, y, yaw = moved.tolist()
    v, w = FASTEST
    return math.hypot(x, y) > MARGIN_M + v * dt or abs(yaw) > MARGIN_RAD + w * dt
