"""The prediction: from odometry, gyro or constant velocity, to the instant of each record.

Odometry says what happened up to its own stamp. When a scan is newer, the pose is carried ahead by the velocity, and
that carry (``ahead``) is taken back as soon as odometry for the same stretch arrives; so no motion is counted twice,
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
"""Beyond this a velocity says nothing any more; the pose is held and the uncertainty grows instead."""

UNSEEN = np.array((0.5, 0.5, 0.5))
"""One-sigma speed (m/s, m/s, rad/s) of a robot that nobody watches: it may be pushed, or go on at walking pace."""
LARGEST_TURN = math.pi
"""No heading is less certain than one that may be any."""
STILL_M, STILL_RAD = 0.03, 0.02
"""A robot has stood for as long as it is found no further than that from where it was: the noise of good matches."""
STARTS_S = 0.2
"""So long a robot that stands is taken to be starting, as one that drives may: a scan that finds it on its way, or the
one after a scan that was lost, must not come as a surprise."""

DYING = 0.8
"""Of a velocity that nothing confirms so much is left after each scan."""

GYRO_RAD = 5e-4
"""Error of a gyro reading's turn: rate noise and bias of a consumer MEMS gyro over some 10 ms."""
BIAS_LEARNING = 0.02
"""Share of the difference to a match's turn that goes into the gyro's bias, per 0.1 s."""
GYRO_GATE = 5.0
"""Deviations beyond which a gyro is not believed: wrong units, or damaged. No robot gains speed like that."""

DOUBT_LEARNING, SURPRISE_CAP, DOUBT_CAP = 0.03, 10.0, 100.0
DOUBT_LEAST = 1.0
"""Wheels that have been good for long may slip at any moment: they are never believed more than is stated."""
LEAST_EXPECTED = 0.3
"""A match that should correct the prediction by less than a tenth of what it could says little about it."""


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """One-sigma errors of a motion.

    Attributes:
        slip: of a travelled metre, m. skid: m of sideways error per radian turned. turn: rad per radian turned.
        drift: rad per metre travelled.
        floor_m, floor_rad: random walk of odometry over 0.2 s (encoder steps, stamp jitter).
        acceleration, angular_acceleration: what constant velocity does not know, m/s^2 and rad/s^2.
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
    """What the gyro has added up: since the last odometry, and since the last match; and its bias, learned there."""

    turned_rad: float = 0.0
    span_s: float = 0.0
    match_turned_rad: float = 0.0
    match_span_s: float = 0.0
    bias_rad_s: float = 0.0

    def add(self, turn: float, dt: float) -> None:
        """Take in a reading, less the bias."""
        self.turned_rad += turn
        self.span_s += dt
        self.match_turned_rad += turn
        self.match_span_s += dt

    def learn(self, turned_rad: float, dt: float) -> None:
        """Compare with the turn that two matches ``dt`` apart have shown, if readings covered it."""
        span, said = self.match_span_s, self.match_turned_rad
        self.match_turned_rad = self.match_span_s = 0.0
        if dt > 0.0 and abs(span - dt) < 0.3 * dt:
            self.bias_rad_s += BIAS_LEARNING * min(1.0, dt / 0.1) * (said * dt / span - turned_rad) / dt


@dataclass(slots=True, eq=False)
class Motion:
    """The moving pose and its uncertainty: the predicted half of a filter.

    Attributes:
        t_mono: instant the pose is true for. T_odom_base: the pose.
        P: 3x3 covariance of the pose relative to the local map (odom-aligned axes).
        velocity, velocity_variance: (v_x, v_y, yaw rate) in the base frame.
        t_felt: instant up to which the velocity's variance has grown. t_gyro: the same of what a gyro told.
        t_told: when a match or wheels last told the pose; since then the velocity has carried it.
        T_stood: where it stands, or last stood; t_stood: since when, infinite before anything is known.
        ahead: motion already applied beyond the last odometry. odometry: whether any has arrived; t_odometry: its end.
        doubt: factor on the noise's variance, learned. gyro: sums and bias. trail: the way of the last two seconds.
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
    T, P = np.empty(3), np.empty((3, 3))  # others may hold on to the pose before
    carry_on(motion.T_odom_base, delta, variance, motion.P, T, P)
    motion.T_odom_base, motion.P = T, P


def on_odometry(motion: Motion, record: Odometry, noise: MotionNoise) -> None:
    """Replace what was carried ahead by what the wheels say, and their turn by the gyro's where it covers the stretch.

    An increment that is no number is passed over.
    Only an increment that follows on the last one speaks of the same stretch as the carry. One that begins anew (a
    sender switched on late) or bridges a silence adds what lies after the present instant: until then the pose has been
    held by others.
    """
    if not all(map(math.isfinite, record.delta.tolist())):
        return
    dt = record.t_end - record.t_begin
    delta = np.array(record.delta, dtype=np.float64)  # a kernel takes no view of something else
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
    """Variance (x, y, yaw) of an odometry increment over ``dt``."""
    x, y, yaw = delta.tolist()
    way, turned, share = math.hypot(x, y), abs(yaw), min(1.0, max(dt, 0.02) / 0.2)
    along = noise.slip * way + noise.skid * turned
    heading = noise.turn * turned + noise.drift * way
    floor = share * noise.floor_m**2
    return np.array((along**2 + floor, 0.25 * along**2 + floor, heading**2 + share * noise.floor_rad**2))


def feel(motion: Motion, delta: Array, interval: tuple[float, float], variance: Array, noise: MotionNoise) -> None:
    """Update the velocity by a motion ``delta`` made over an interval: a scalar Kalman filter for each component.

    A mean over the interval is taken for its end, which adds half the interval's worth of unknown acceleration.
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
    """Turn by what the gyro says over its interval, less its bias, and move on at the velocity.

    A rate that the turn rate known so far cannot have become meanwhile is passed over: taken for certain, it would
    carry the pose to where no scan fits, and the map would be begun anew there.
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
    """Bring the pose to ``t_mono`` at constant velocity; an instant in the past changes nothing.

    :data:`LONGEST_CARRY_S` after the last that told it, the pose is held, whether others are heard meanwhile or not.
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
    """Note whether the pose is still where the robot has stood; else it has moved, and stands here at best."""
    x, y, yaw = se2.between(motion.T_stood, motion.T_odom_base).tolist()
    if not (motion.t_stood <= t_mono and math.hypot(x, y) < STILL_M and abs(yaw) < STILL_RAD):
        motion.T_stood, motion.t_stood = motion.T_odom_base.copy(), t_mono


def slow_down(motion: Motion) -> None:
    """A velocity that nothing confirms is let die; what is taken from its square, it may be wrong by."""
    square = motion.velocity * motion.velocity
    motion.velocity = DYING * motion.velocity
    motion.velocity_variance = motion.velocity_variance + (1.0 - DYING * DYING) * square


def untold(motion: Motion) -> tuple[float, float, float]:
    """For how long nothing has told where the robot is (x, y) and looks (yaw), s; 0 before anything ever has."""
    place = motion.t_mono - motion.t_told
    heading = motion.t_mono - max(motion.t_told, motion.t_gyro)
    place, heading = (max(0.0, t) if math.isfinite(t) else 0.0 for t in (place, heading))
    return place, place, heading


def carried_variance(motion: Motion, before: tuple[float, float, float], dt: float, noise: MotionNoise) -> Array:
    """Variance (x, y, yaw) that carrying the pose on for ``dt`` seconds adds, ``before`` so long carried already.

    What the velocity is wrong by stays the same from one carry to the next, so that errors add up, and not variances:
    a robot that hears of its lamps between two scans knows no better how it moves than one that does not. Only a gyro
    says anew how it turns. So this is what has added up by the end, less what had by the begin, however time is cut.
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
    """Variance of how far a robot is along an axis from where its velocity of ``t`` seconds ago has brought it.

    The velocity is another one by the acceleration that nobody knows, but by no more than that of a robot which nobody
    watches; after :data:`LONGEST_CARRY_S` the pose is held, and all of such a velocity is its error. One that has
    ``stood`` for so many seconds goes on standing for another ``t`` with the chance ``stood / (stood + t)``: nothing
    says how long a halt lasts but how long it has lasted. If it starts, any moment is as likely, which makes the square
    of its way a third.
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
    """Learn from a match how far the prediction can be trusted; returns the covariance (3, 3) that this one's lacked.

    Noise figures are those of a good robot. Where wheels slip or stamps jitter, matches keep correcting the prediction
    by more than its deviation says, and ``doubt`` scales the noise of the predictions to come. Of a prediction's own
    variance, a match with the information ``H`` (3, 3) corrects the part ``(L + H)^-1 H``; the square that it should
    have is that much. A correction beyond three deviations makes them a third of itself, along itself alone: across it
    nothing was wrong, and an axis that no match holds would be blown up by every surprise along the other one, without
    end.
    """
    L = invert3(motion.P)
    square = float(correction @ L @ correction)
    if known:
        expected = float((invert3(L + H) * H).sum())  # trace of the product of two symmetric matrices
        seen = motion.doubt * min(square / max(expected, LEAST_EXPECTED), SURPRISE_CAP)
        motion.doubt = min(max(DOUBT_LEAST, motion.doubt + DOUBT_LEARNING * (seen - motion.doubt)), DOUBT_CAP)
    return max(0.0, 1.0 / 9.0 - 1.0 / max(square, 9.0)) * np.outer(correction, correction)


FASTEST = (1.0, 2.0)
"""m/s, rad/s. No robot indoors drives so much faster than its wheels, or its velocity, state; but wheels slip in turns,
and stamps come late."""
MARGIN_M, MARGIN_RAD = 0.4, 0.2
"""A pose may move by so much more than a robot drives: matches of one place differ by less."""


def too_far(moved: Array, dt: float) -> bool:
    """Whether a pose has moved (x, y, yaw) farther than a robot can drive in ``dt`` seconds."""
    x, y, yaw = moved.tolist()
    v, w = FASTEST
    return math.hypot(x, y) > MARGIN_M + v * dt or abs(yaw) > MARGIN_RAD + w * dt
