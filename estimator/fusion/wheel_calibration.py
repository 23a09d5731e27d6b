"""Online calibration of wheels and lidar mount: the lasting errors of odometry, estimated from matches while driving.

Five errors stay the same from one metre to the next: scale of distances, scale of turns, turn per metre, and the
deviation of the lidar mount from the configuration (yaw, lateral position; the longitudinal one acts like a skid). They
are the state of a Kalman filter. One step compares the motion of ``T_odom_base`` between two matches with that of the
wheels (A. Censi et al., IEEE Trans. Robotics 29, 2013). Wheels slip and matches slide, so a step has a Student-t
likelihood. Errors can change: they are also estimated from recent steps alone, and these replace the former ones where
both exclude each other. A heading that jumps from one scan to the next shows that the robot was turned, or its mount.
The next steps decide that; until then the jump is a doubt about the heading (`on_heading`).

Large wheel errors correct the prediction (`corrected`), a large error of the mount corrects the mount
(`mount_correction`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from estimator.fusion.gyro_calibration import GyroCalibration
from estimator.measurements import Odometry
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import SlowError, SlowErrors

STEP_M, STEP_RAD = 1.0, 0.5
"""Distance (m) and turn (rad) of one step: matches are then accurate to a per cent or two of it."""
LARGEST_STEP: Final = 10.0
"""Distance (m) and turn (rad) of a step that is an error of odometry: one reading ends it."""
LONGEST_S: Final = 10.0
"""Longest duration (s) of a step; a robot that hardly moves shows nothing."""
SPLIT_S: Final = 0.5
"""Longest duration (s) of an odometry reading that may be divided at a match within it."""
SOUND: Final = np.array((0.04, 0.02, 0.05, math.radians(0.5), 0.02))
"""Sigmas of the errors of a sound robot: wheel diameter worn by 4 %, track known to 2 %, 3 deg per metre by unequal
wheels (docs/lights.md allows as much), mount set by hand to half a degree and 2 cm."""
WIDE: Final = np.array((0.3, 0.3, 0.2, math.radians(6.0), 0.1))
"""Prior sigmas: those of a robot with a wrong wheel, gear, or a mount that was knocked."""
NOISE: Final = (0.012, 0.012, 0.006)
"""Sigmas (m, m, rad) of the two matches that limit a step."""
SLIP, SLIP_TURN, SLIP_DRIFT = 0.02, 0.1, 0.01
"""Random part of wheel motion over one step: share of distance, share of turn, and turn per metre (rad/m)."""
FIRST_NOISE, WEIGHT, LEARNING, FEWEST = 10.0, 4, 0.05, 12
"""Initial factor on these variances, as of the worst robots in recordings, and its weight in steps; least share of one
step in the learned factor; fewest steps before an error is named: one slip must not decide."""
NU: Final = 4.0
"""Degrees of freedom of the Student-t likelihood: the heavy tail of slip."""
RECENT: Final = 20
"""Steps after which the recent errors are estimated anew."""
CHANGED: Final = 51.4
"""Squared Mahalanobis distance of recent errors from former ones above which the errors have changed.

It is twice the 99.99 % quantile of chi-square with 5 degrees of freedom: slip and stamp errors repeat.
"""
MOST_LEARNED: Final = 16.3
"""Largest squared Mahalanobis distance (99.9 % of chi-square with 3 degrees) of which the noise is learned."""
SURPRISE: Final = 51.4
"""Squared Mahalanobis distance of a heading correction that slip does not explain: 99.9 % of Student's t with NU."""
STAMP_S: Final = 0.05
"""Sigma (s) of the time offset between lidar and wheels, before it is known: half a period of a slow lidar."""
USUAL, TAIL = 0.05, 9.0
"""Share of a correction in their usual mean square, and the most multiple of that which it counts for."""
SMALL: Final = 1e-4
"""Difference for the derivatives by the mount."""
LARGE, SURE = 3.0, 2.5
"""Sigmas of a sound robot beyond which an error is large, and sigmas of the estimate by which it must exceed that."""


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """An estimate: errors ``x`` (scale of distances, of turns, rad/m, mount yaw in rad, mount y in m), ``P`` (5, 5)."""

    x: Array = field(default_factory=lambda: np.zeros(5))
    P: Array = field(default_factory=lambda: np.diag(WIDE**2))


@dataclass(slots=True, eq=False)
class WheelCalibration:
    """State of the calibration.

    Attributes:
        errors: of all steps since the last change. recent, former: of the steps since the latest of every
            :data:`RECENT`, and of those before; the two share no data.
        steps: number of steps.
        fix: the three wheel errors as corrected: zero, unless one is large. Small ones are known from matches alone. A
            correction would make the prediction repeat what matches say, and drift with them along corridors.
        path: (x, y, yaw) of the wheels since the step began, without the estimated errors.
        slopes: its derivatives (3, 3) by the three wheel errors.
        latest, span: latest reading (x, y, yaw), and its duration, s.
        t_wheels: end of the latest reading.
        begun: instant and T_odom_base of the match that began the step.
        noise: learned factor on the variance of a step, which depends on lidar, stamps and floor.
        waiting: a match after the latest reading: instant and T_odom_base.
        mount: correction of the lidar mount so far (x, y, yaw); ``errors`` has what remains.
        usual: mean square of heading corrections, rad^2. rate: turn rate at the latest one, rad/s.
        jumped: heading jump (rad) of the matches that neither wheels nor mount explain yet, 0 without one.
        gyro: calibration of the gyro.
        told: errors beyond what a sound robot has; None where there is none.
    """

    errors: Errors = field(default_factory=Errors)
    recent: Errors = field(default_factory=Errors)
    former: Errors = field(default_factory=Errors)
    steps: int = 0
    fix: Array = field(default_factory=lambda: np.zeros(3))
    path: Array = field(default_factory=se2.identity)
    slopes: Array = field(default_factory=lambda: np.zeros((3, 3)))
    latest: Array = field(default_factory=se2.identity)
    span: float = 0.0
    t_wheels: float = -math.inf
    begun: tuple[float, Array] | None = None
    noise: float = FIRST_NOISE
    waiting: tuple[float, Array] | None = None
    mount: Array = field(default_factory=se2.identity)
    usual: float = 0.0
    rate: float = 0.0
    jumped: float = 0.0
    gyro: GyroCalibration = field(default_factory=GyroCalibration)
    told: SlowErrors | None = None

    @property
    def doubt(self) -> float:
        """Variance (rad^2) of the heading after a jump: no more than that of the lidar mount, once steps show it."""
        return min(self.jumped**2, mount_square(self.errors))

    @property
    def mount_rad(self) -> float:
        """Largest remaining heading error (rad) by the lidar mount, where that is large; else 0."""
        if self.told is None or not self.told.large[SlowError.MOUNT_YAW]:
            return 0.0
        return abs(float(self.errors.x[SlowError.MOUNT_YAW])) + LARGE * self.told.sigma[SlowError.MOUNT_YAW]


def mount_square(errors: Errors) -> float:
    """Mean square of the mount's yaw error, rad^2."""
    return float(errors.x[SlowError.MOUNT_YAW] ** 2 + errors.P[SlowError.MOUNT_YAW, SlowError.MOUNT_YAW])


def widened(errors: Errors, square: float) -> Errors:
    """The errors with a variance (rad^2) added to the mount's yaw."""
    P = errors.P.copy()
    P[SlowError.MOUNT_YAW, SlowError.MOUNT_YAW] += square
    return Errors(errors.x, P)


def corrected(wheels: WheelCalibration, record: Odometry) -> Odometry:
    """The reading without the estimated wheel errors."""
    x, y, yaw = record.delta.tolist()
    a, b, c = wheels.fix.tolist()
    if not math.isfinite(x + y + yaw):
        return record
    more = b * yaw + c * math.copysign(math.hypot(x, y), x)
    turn = 0.5 * more  # the direction changes by half of the additional turn
    cos, sin = (1.0 + a) * math.cos(turn), (1.0 + a) * math.sin(turn)
    return replace(record, delta=np.array((cos * x - sin * y, sin * x + cos * y, yaw + more)))


def on_odometry(wheels: WheelCalibration, record: Odometry) -> None:
    """Extend the path of the step; readings that do not follow each other, or are not finite, end it."""
    span, match = record.t_end - record.t_begin, wheels.waiting
    usable = span > 0.0 and bool(np.isfinite(record.delta).all())
    if not usable or abs(record.t_begin - wheels.t_wheels) > 1e-6:
        wheels.begun = wheels.waiting = match = None
    wheels.t_wheels = record.t_end
    if not usable:
        return
    wheels.latest, wheels.span = record.delta, span
    if wheels.begun is not None:
        extend(wheels, record.delta)
    if match is not None and match[0] <= record.t_end:
        wheels.waiting = None
        take(wheels, *match)


def extend(wheels: WheelCalibration, delta: Array) -> None:
    """Add a motion of the wheels to the path, and its effect to the derivatives."""
    dx, dy, dyaw = delta.tolist()
    a, b, c, _, _ = wheels.errors.x.tolist()
    x, y, yaw = wheels.path.tolist()
    way, J = math.copysign(math.hypot(dx, dy), dx), wheels.slopes
    turn = (1.0 + b) * dyaw + c * way
    half = yaw + 0.5 * (turn - dyaw)
    if not math.isfinite(half):  # readings of an absurd size
        wheels.begun = None
        return
    cos, sin = math.cos(half), math.sin(half)
    ux, uy = cos * dx - sin * dy, sin * dx + cos * dy
    px, py = (1.0 + a) * ux, (1.0 + a) * uy
    J[:2, SlowError.DISTANCE] += ux, uy
    for k, more in ((SlowError.TURN, 0.5 * dyaw), (SlowError.DRIFT, 0.5 * way)):
        turned = float(J[2, k]) + more
        J[0, k] -= turned * py
        J[1, k] += turned * px
        J[2, k] += 2.0 * more
    wheels.path = np.array((x + px, y + py, yaw + turn))


def on_heading(wheels: WheelCalibration, off: float, variance: float, rate: float) -> None:
    """Notice a heading jump: a correction ``off`` (rad) far outside its ``variance``, at a turn ``rate`` (rad/s).

    Between two matches, a time offset adds an error only by a change of the rate. The mount's yaw may have changed by
    as much as the heading; a jump back ends the doubt.
    """
    square = off * off
    expected = variance + wheels.usual + (STAMP_S * (rate - wheels.rate)) ** 2
    wheels.rate = rate
    least = LARGE * float(SOUND[SlowError.MOUNT_YAW])
    if wheels.usual and abs(off) > least and square > SURPRISE * expected:
        wheels.jumped += off
        wheels.begun = wheels.waiting = None
        wheels.errors, wheels.recent = widened(wheels.errors, square), widened(wheels.recent, square)
        if abs(wheels.jumped) < least:
            wheels.jumped = 0.0
    wheels.usual += USUAL * (min(square, TAIL * wheels.usual) - wheels.usual) if wheels.usual else square


def on_match(wheels: WheelCalibration, t_mono: float, T_odom_base: Array, complete: bool) -> None:
    """Take the pose of a match; ``complete``: it is good and fixed every axis. Any other match ends the step.

    A match after the latest reading waits for the next one.
    """
    if not complete:
        wheels.begun = wheels.waiting = None
    elif t_mono > wheels.t_wheels:
        wheels.waiting = t_mono, T_odom_base.copy()
    else:
        take(wheels, t_mono, T_odom_base.copy())


def take(wheels: WheelCalibration, t_mono: float, T_odom_base: Array) -> None:
    """Begin or end a step at a match within the latest reading; the part of the reading after it belongs to the next.

    An older match is not used.
    """
    late = wheels.t_wheels - t_mono
    if not late <= wheels.span or (late > 0.0 and wheels.span > SPLIT_S):
        return
    rest = wheels.latest * (late / wheels.span) if late > 0.0 else se2.identity()
    if wheels.begun is not None:
        far = abs(float(wheels.path[2])) >= STEP_RAD or math.hypot(*wheels.path[:2].tolist()) >= STEP_M
        if not far and t_mono - wheels.begun[0] < LONGEST_S:
            return
        extend(wheels, -rest)
        if far:
            compare(wheels, se2.between(wheels.begun[1], T_odom_base))
    wheels.begun = t_mono, T_odom_base
    wheels.path, wheels.slopes = se2.identity(), np.zeros((3, 3))
    extend(wheels, rest)


def compare(wheels: WheelCalibration, made: Array) -> None:
    """Update the errors by one step; ``made``: motion of T_odom_base (x, y, yaw)."""
    off, J = made - on_mount(wheels.path, wheels.errors.x), slopes_of(wheels)
    off[2] = se2.wrap(float(off[2]))
    way, turned = math.hypot(*wheels.path[:2].tolist()), abs(float(wheels.path[2]))
    if not max(way, turned) < LARGEST_STEP:
        return
    slip, turn = (SLIP * way) ** 2, (SLIP_TURN * turned) ** 2 + (SLIP_DRIFT * way) ** 2
    R = wheels.noise * np.diag((NOISE[0] ** 2 + slip, NOISE[1] ** 2 + slip, NOISE[2] ** 2 + turn))
    recent_off = off - J @ (wheels.recent.x - wheels.errors.x)
    errors, square = updated(wheels.errors, off, J, R)
    recent, recent_square = updated(wheels.recent, recent_off, J, R)
    if not (math.isfinite(square + recent_square) and np.isfinite(errors.x).all() and np.isfinite(recent.x).all()):
        return
    wheels.errors, wheels.recent = errors, recent
    least = min(square, recent_square, MOST_LEARNED)
    share = max(LEARNING, 1.0 / (wheels.steps + WEIGHT))
    wheels.noise = max(1.0, wheels.noise * (1.0 + share * (least / 3.0 - 1.0)))
    wheels.steps += 1
    apart = wheels.recent.x - wheels.former.x
    if float(apart @ np.linalg.solve(wheels.recent.P + wheels.former.P, apart)) > CHANGED:
        wheels.errors = wheels.former = wheels.recent
    if wheels.steps % RECENT == 0:
        wheels.former, wheels.recent = wheels.errors, Errors()
    if not half_turned(wheels):
        wheels.jumped = 0.0
    wheels.told = judged(wheels.errors, wheels.mount) if wheels.steps >= FEWEST else None
    wheels.fix = wheels.errors.x[:3] if wheels.told is not None and wheels.told.wheels else np.zeros(3)


def half_turned(wheels: WheelCalibration) -> bool:
    """Whether the mount may have turned by half of the heading jump or more; else the robot was turned."""
    yaw, variance = wheels.errors.x[SlowError.MOUNT_YAW], wheels.errors.P[SlowError.MOUNT_YAW, SlowError.MOUNT_YAW]
    return abs(float(yaw)) + SURE * math.sqrt(float(variance)) >= 0.5 * abs(wheels.jumped)


def slopes_of(wheels: WheelCalibration) -> Array:
    """Derivatives (3, 5) of the motion of T_odom_base by the errors."""
    J, x = np.empty((3, 5)), wheels.errors.x
    seen, yaw = on_mount(wheels.path, x), float(x[SlowError.MOUNT_YAW])
    R = se2.rotation(-yaw)[:2, :2]
    J[:2, :3], J[2, :3] = R @ wheels.slopes[:2], wheels.slopes[2]
    for k in (SlowError.MOUNT_YAW, SlowError.MOUNT_Y):
        J[:, k] = (on_mount(wheels.path, x + SMALL * (np.arange(5) == k)) - seen) / SMALL
    return J


def updated(errors: Errors, off: Array, J: Array, R: Array) -> tuple[Errors, float]:
    """Errors after a measurement with a Student-t likelihood, and its squared Mahalanobis distance."""
    S = J @ errors.P @ J.T + R
    square = float(off @ np.linalg.solve(S, off))
    R = R * max(1.0, (NU + square) / (NU + 3.0))
    K = np.linalg.solve(J @ errors.P @ J.T + R, J @ errors.P).T
    keep = np.eye(5) - K @ J
    return Errors(errors.x + K @ off, keep @ errors.P @ keep.T + K @ R @ K.T), square


def on_mount(path: Array, x: Array) -> Array:
    """Motion of T_odom_base with the mount error of ``x`` (5,): ``M^-1 path M``."""
    M = np.array((0.0, x[SlowError.MOUNT_Y], x[SlowError.MOUNT_YAW]))
    return se2.between(M, se2.compose(path, M))


def judged(errors: Errors, mount: Array) -> SlowErrors | None:
    """The errors together with those of the mount that are corrected, where one is outside what a sound robot has."""
    sigma, x = np.sqrt(errors.P.diagonal()), errors.x.copy()
    x[[SlowError.MOUNT_Y, SlowError.MOUNT_YAW]] += mount[1:]
    large = np.abs(x) - SURE * sigma > LARGE * SOUND
    if not large.any():
        return None
    return SlowErrors(tuple(x.tolist()), tuple(sigma.tolist()), tuple(large.tolist()))
