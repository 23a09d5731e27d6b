"""Time update of the light filter: odometry, gyro or constant velocity move every hypothesis alike.

Odometry is valid up to its own stamp. When a newer record arrives, the pose is extrapolated at the velocity. The
extrapolation (``ahead``) is removed when odometry of the same interval arrives. A late epoch of light is compared with
the dead-reckoned pose at its instant: the state is never rewound.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from estimator.light_filter import state_vector
from estimator.light_filter.filter_state import Lights, Track
from estimator.measurements import Imu, Odometry
from estimator.numerics import se2
from estimator.numerics.arrays import Array

CARRY_S: Final = 0.5
"""Age (s) of odometry after which it has ended, and constant velocity replaces it."""
GYRO_FRESH_S: Final = 0.1
"""Age (s) of the gyro after which it has ended."""
UNSEEN: Final = 0.5
"""Sigma of the speed (m/s, rad/s) of a robot without any sensor data."""
REVERSE_M_S: Final = 0.1
"""Backward speed (m/s) below which a robot is not taken to reverse."""
TOLD_S: Final = 2.0
"""Time (s) after the last odometry during which a reversing robot is accepted."""
STILL: Final = 0.08
"""Speed (m/s) below which a robot without odometry is at rest."""
AT_MOST: Final = (5.0, 5.0, 10.0)
"""Speed limits of any indoor robot: m/s, m/s and rad/s. Odometry above them has valid motion, but wrong stamps."""
FASTEST: Final = 20.0
"""Largest motion (m or rad) of one record. A larger one is a counter that has jumped."""


def on_odometry(lights: Lights, record: Odometry, velocity: Array | None = None) -> None:
    """Predict with odometry, less the earlier extrapolation; the gyro replaces the turn where it covers the interval.

    Late odometry, which light has overtaken, is extrapolated to the present instant again. The noise is that of the
    measured motion. The error of the extrapolation is not an error of the odometry.

    Args:
        lights: state of the filter.
        record: the motion.
        velocity: (v_x, v_y, yaw rate) of lidar odometry, which replaces wheels; None for wheels.
    """
    course, noise, matched = lights.course, lights.settings.motion, velocity is not None
    delta = np.array(record.delta, dtype=np.float64)
    dt = record.t_end - record.t_begin
    largest = max([abs(part) if math.isfinite(part) else math.inf for part in delta.tolist()])
    if not (largest < FASTEST and record.t_end > course.t_odometry):
        return
    if not course.wheels:
        settle(lights)
    if course.matched is not matched:
        course.matched = matched
        begin_scales(lights)
    turned, later = gyro_until(lights, record.t_end)
    by_gyro = dt > 0.0 and abs(turned[1] - dt) < 0.3 * dt
    if by_gyro:
        delta = np.array((delta[0], delta[1], turned[0] * dt / turned[1]))
    if velocity is None:
        velocity = se2.log(delta) / dt if 1e-3 < dt < CARRY_S else course.velocity
    if all(abs(part) <= most for part, most in zip(velocity.tolist(), AT_MOST, strict=True)):
        course.velocity = velocity.copy()
    if abs(record.t_begin - course.t_odometry) < 1e-6 and dt < CARRY_S:
        ahead = se2.exp(course.velocity * min(max(course.t_mono - record.t_end, 0.0), CARRY_S))
        if later[1] > 0.0:
            ahead[2] = later[0] + course.velocity[2] * max(course.t_mono - course.t_gyro, 0.0)
        made, told = se2.between(course.ahead, se2.compose(delta, ahead)), delta
    else:
        ahead = se2.inverse(back_to(lights, record.t_end)) if course.t_mono > record.t_end else se2.identity()
        made = told = record.part_after(course.t_mono, delta)
    way, turn = math.hypot(told[0], told[1]), abs(float(told[2]))
    idle = min(max(dt, 0.0), CARRY_S)
    skid = noise.skid**2 * turn
    q = (
        noise.slip**2 * way + skid + noise.idle_m**2 * idle,
        noise.side**2 * way + skid + noise.idle_m**2 * idle,
        (0.0 if by_gyro else noise.turn**2 * turn + noise.wander**2 * way) + noise.idle_rad**2 * idle,
    )
    blame = (0.0, 0.0, 0.0, 0.0 if by_gyro else made[2], 0.0 if by_gyro else made[0], 0.0, 1.0)
    course.gyro_turned, course.gyro_span = later
    course.t_odometry = record.t_end
    move_all(lights, made, np.array(blame), np.array(q), max(course.t_mono, record.t_end))
    course.ahead = ahead


def gyro_until(lights: Lights, t_end: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Gyro angle and time (rad, s) since the last odometry: until an instant, and after it."""
    course = lights.course
    later_s = min(max(course.t_gyro - t_end, 0.0), course.gyro_span)
    later = float(course.velocity[2]) * later_s, later_s
    return (course.gyro_turned - later[0], course.gyro_span - later_s), later


def on_imu(lights: Lights, record: Imu) -> None:
    """Turn by the gyro over the part of its interval that is still to come, and extrapolate the position."""
    course, noise = lights.course, lights.settings.motion
    dt = record.t_end - record.t_begin
    if not (0.0 < dt < CARRY_S and abs(record.dyaw) < FASTEST * dt):
        return
    course.velocity[2] = record.dyaw / dt
    course.gyro_turned += record.dyaw
    course.gyro_span += dt
    course.t_gyro = record.t_end
    share = 1.0 if course.t_mono == -math.inf else min(1.0, max(0.0, (record.t_end - course.t_mono) / dt))
    carry_to(lights, record.t_begin)
    glide(lights, record.t_end, float(record.dyaw) * share, noise.gyro)


def carry_to(lights: Lights, t_mono: float) -> None:
    """Extrapolate the poses to an instant at the velocity; an earlier instant changes nothing."""
    course = lights.course
    if not t_mono > course.t_mono:
        return
    if course.t_mono == -math.inf:
        course.t_mono = t_mono
        return
    if course.wheels and course.t_mono - course.t_odometry >= CARRY_S:
        release(lights)
    if gyro(lights) or course.wheels:
        spread = lights.settings.motion.gyro if gyro(lights) else lights.settings.motion.angular
        glide(lights, t_mono, float(course.velocity[2]) * min(t_mono - course.t_mono, CARRY_S), spread)
    else:
        glide(lights, t_mono, None, lights.settings.motion.angular)


def gyro(lights: Lights) -> bool:
    """Whether the gyro is available."""
    return lights.course.t_mono - lights.course.t_gyro < GYRO_FRESH_S


def glide(lights: Lights, t_mono: float, turn: float | None, spread: float) -> None:
    """Extrapolate to an instant: by the last odometry's speed while that is fresh, else by the speed in the state.

    Args:
        lights: state of the filter.
        t_mono: end of the extrapolation, s.
        turn: rad by gyro or odometry; None: by the rate in the state.
        spread: rad per root second of error of that turn.
    """
    course, noise = lights.course, lights.settings.motion
    dt = min(t_mono - course.t_mono, CARRY_S)
    if not dt > 0.0:
        return
    unseen = t_mono - course.t_mono - dt
    by_gyro = gyro(lights)
    drift = -dt if by_gyro else 0.0
    push, spin = (UNSEEN * unseen) ** 2, min(UNSEEN * unseen, math.pi) ** 2
    if course.wheels:
        ahead, side = float(course.velocity[0]) * dt, float(course.velocity[1]) * dt
        delta = np.array((ahead, side, turn or 0.0))
        blame = (0.0, 0.0, 0.0, 0.0 if by_gyro else turn or 0.0, 0.0 if by_gyro else ahead, drift, 1.0)
        spread = spread if by_gyro else 0.0
        course.ahead = se2.compose(course.ahead, delta)
    else:
        delta = np.array((0.0, 0.0, turn or 0.0))
        blame = (dt, dt, dt if turn is None else 0.0, 0.0, 0.0, drift, 0.0)
        spread = 0.0 if turn is None else spread
    q = np.array((noise.idle_m**2 * dt + push, noise.idle_m**2 * dt + push, spread**2 * dt + spin))
    move_all(lights, delta, np.array(blame), q, t_mono)
    if not course.wheels:
        drive(lights, dt)


def move_all(lights: Lights, delta: Array, blame: Array, q: Array, t_mono: float) -> None:
    """Move every hypothesis, and the dead-reckoned history with the likeliest."""
    course = lights.course
    made = delta
    for k, track in enumerate(lights.tracks):
        if k == 0:
            made = delta + track.x[state_vector.SPEED : state_vector.TURN + 1] * blame[:3]
        state_vector.move(track.x, track.P, track.n, delta, blame, q)
    course.T = se2.compose(course.T, made)
    way = math.hypot(made[0], made[1])
    if course.matched and course.wheels:  # the noise of matches must not count as path length
        speed = math.hypot(course.velocity[0], course.velocity[1])
        way = speed * (t_mono - course.t_mono) if speed > STILL and math.isfinite(course.t_mono) else 0.0
    course.way += way if course.wheels else max(0.0, way - STILL * float(blame[0]))
    course.t_mono = max(course.t_mono, t_mono)
    course.trail.add(course.t_mono, course.T)


def drive(lights: Lights, dt: float) -> None:
    """Process noise of constant velocity: forward speed wanders, sideways speed and turn rate decay."""
    noise = lights.settings.motion
    for track in lights.tracks:
        keep, grow = np.ones(track.n), np.zeros(track.n)
        keep[state_vector.SIDE], keep[state_vector.TURN] = math.exp(-dt / 0.3), math.exp(-dt / 2.0)
        grow[state_vector.SPEED] = noise.acceleration**2 * dt
        grow[state_vector.SIDE] = noise.sideways**2 * (1.0 - keep[state_vector.SIDE] ** 2)
        grow[state_vector.TURN] = noise.angular**2 * dt
        state_vector.fade(track.x, track.P, track.n, keep, grow)


def set_speed(track: Track, velocity: Array, sigma: tuple[float, float, float]) -> None:
    """Set the speeds in the state, independent of everything else."""
    for j, (value, one) in enumerate(zip(velocity.tolist(), sigma, strict=True), start=state_vector.SPEED):
        state_vector.cut(track.P, track.n, j)
        track.x[j], track.P[j, j] = value, one**2


def settle(lights: Lights) -> None:
    """Odometry has started: set the speeds in the state to zero without variance."""
    lights.course.wheels = True
    for track in lights.tracks:
        set_speed(track, np.zeros(3), (0.0, 0.0, 0.0))


def begin_scales(lights: Lights) -> None:
    """The odometry source has changed: reset its scales, of wheels to an earlier run's, of matches to the prior."""
    mean, variance = wheel_scales(lights)
    if lights.course.matched:
        mean, variance = np.zeros(3), prior_scales(lights)
    for track in lights.tracks:
        for k, j in enumerate(range(state_vector.SCALE, state_vector.CURVE + 1)):
            state_vector.cut(track.P, track.n, j)
            track.x[j], track.P[j, j] = mean[k], variance[k]


def wheel_scales(lights: Lights) -> tuple[Array, Array]:
    """Means and variances of the wheels' scale of path, scale of turns, and curve, from an earlier run."""
    if lights.before is None:
        return np.zeros(3), prior_scales(lights)
    of = slice(state_vector.SCALE, state_vector.CURVE + 1)
    return lights.before.x[of].copy(), np.minimum(np.diag(lights.before.P)[of], prior_scales(lights))


def prior_scales(lights: Lights) -> Array:
    """Prior variances of the scale of path, the scale of turns, and the curve."""
    noise = lights.settings.motion
    return np.array((noise.scale, noise.turn_scale, noise.curve)) ** 2


def release(lights: Lights) -> None:
    """Odometry has ended: the speeds in the state continue from its last velocity."""
    course, noise = lights.course, lights.settings.motion
    for track in lights.tracks:
        set_speed(track, course.velocity, (0.5 * noise.speed, noise.sideways, 0.3))
    course.wheels, course.ahead = False, se2.identity()


def face_forward(lights: Lights, track: Track) -> None:
    """Without odometry, turn a hypothesis round that drives backward.

    RSS and gyro cannot distinguish it from its mirror image that drives forward. The photodiode stays where it is.
    """
    sigma = math.sqrt(max(float(track.P[state_vector.SPEED, state_vector.SPEED]), 0.0))
    told = lights.course.wheels or lights.course.t_mono - lights.course.t_odometry < TOLD_S
    if told or track.x[state_vector.SPEED] > -max(REVERSE_M_S, 2.0 * sigma):
        return
    receiver = lights.survey.receiver
    c, s = math.cos(track.x[state_vector.YAW]), math.sin(track.x[state_vector.YAW])
    track.x[state_vector.X] += 2.0 * (c * receiver.x - s * receiver.y)
    track.x[state_vector.Y] += 2.0 * (s * receiver.x + c * receiver.y)
    track.x[state_vector.YAW] = se2.wrap(float(track.x[state_vector.YAW]) + math.pi)
    for j in (state_vector.SPEED, state_vector.SIDE, state_vector.LEAN_X, state_vector.LEAN_Y):
        track.x[j] = -track.x[j]
        track.P[j, :] *= -1.0
        track.P[:, j] *= -1.0


def back_to(lights: Lights, t_mono: float) -> Array:
    """Pose at an earlier instant relative to the present pose; before the history, its oldest pose."""
    course = lights.course
    return se2.between(course.T, course.trail.at(t_mono, (course.t_mono, course.T)))
