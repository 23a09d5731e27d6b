"""Fusing a match into the moving pose, and what the filters learn from it."""

from __future__ import annotations

import math

import numpy as np

from estimator.fusion import map_odom_filter, motion_model
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import hang, informed, turn
from estimator.result import MatchResult, Reason
from estimator.scan_matching.residual_correlation import agreement, beams_each
from estimator.state import State

LEAST_NOISE_M = 0.004
LEARNING = 0.02
HELD, HELD_YAW = 100.0, 830.0
"""Information with which a match holds a direction, or the heading: 10 cm, 2 deg (`MatchResult.known_axes`)."""
BLIND = (Reason.TOO_FEW_POINTS, Reason.MALFORMED, Reason.LATE, Reason.PASSED_OVER)
"""Outcomes of a scan that has shown nothing: they do not speak against the map."""
CAUCHY = 0.807
"""What the robust weights of the matcher leave of a Gaussian's variance."""


def fuse(state: State, match: MatchResult) -> None:
    """Take the matched pose and add its information; without odometry it also tells the velocity.

    The match has weighed the prediction in already (Eq. 14), so its pose is the fused pose.
    """
    moving = state.fused
    if match.ok:
        state.failures, state.t_match = 0, moving.t_mono
        learn_noise(state, match)
        T_pred, P_pred = moving.T_odom_base, moving.P
        moving.T_odom_base = match.T_odom_base
        lacked = motion_model.learn(moving, match.correction, match.information, bool(match.known_axes.all()))
        moving.P = updated(P_pred + lacked, match.information, moving.odometry)
        map_odom_filter.on_match(state, T_pred, P_pred, lacked)
        if state.t_scan > -np.inf:
            made = se2.between(state.T_odom_scan, moving.T_odom_base)
            moving.gyro.learn(float(made[2]), moving.t_mono - state.t_scan)
            motion_model.feel(
                moving, made, (state.t_scan, moving.t_mono), 2.0 * moving.P.diagonal(), state.settings.noise
            )
            guess(state, match.information, moving.t_mono - state.t_scan)
    elif match.reason is not Reason.NO_MAP:
        state.failures += match.reason not in BLIND  # who sees nothing contradicts nothing
        if not moving.odometry:
            motion_model.slow_down(moving)
    state.t_scan, state.T_odom_scan = moving.t_mono, moving.T_odom_base


def updated(P: Array, H: Array, odometry: bool) -> Array:
    """Covariance (3, 3) of a prediction ``P`` after a match with information ``H``.

    A direction that the match does not hold gets no surer by it. In a corridor what it does hold is not the same to a
    hair from scan to scan; a tenth of a degree between two of them, forty times a second, would add up to centimetres
    along an axis of which none has seen anything. Without ``odometry`` there is nothing else either: see :func:`guess`.
    """
    after = np.empty((3, 3))
    informed(P, H, after)
    loose = loose_direction(H) if odometry else None
    if loose is not None:
        lost = float(loose @ (P[:2, :2] - after[:2, :2]) @ loose)
        after[:2, :2] += max(0.0, lost) * np.outer(loose, loose)
    if odometry and H[2, 2] < HELD_YAW:
        after[2, 2] = max(float(P[2, 2]), float(after[2, 2]))
    return after


def loose_direction(H: Array) -> Array | None:
    """Unit vector (x, y) along which information ``H`` (3, 3) does not hold the place, None where it holds all."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = H.tolist()
    tt = max(tt, 1e-9)
    xx, xy, yy = xx - xt * xt / tt, xy - xt * yt / tt, yy - yt * yt / tt
    half = 0.5 * math.atan2(2.0 * xy, xx - yy)
    x, y = -math.sin(half), math.cos(half)
    return np.array((x, y)) if x * x * xx + 2.0 * x * y * xy + y * y * yy < HELD else None


def guess(state: State, H: Array, dt: float) -> None:
    """Without wheels, along a direction that the match does not hold the pose is a guess, and the stated place says so.

    The velocity carries the pose on, and no match contradicts it. What it may be wrong by adds up with the way: the map
    that is laid meanwhile is out of place for good, so it is the covariance of the place in the map that grows: at
    walking pace, from half a second on. A silence of the laser has grown the prediction's own covariance already.
    """
    loose = loose_direction(H)
    if state.fused.odometry or loose is None:
        state.guessed_s = 0.0
        return
    before, state.guessed_s = state.guessed_s, state.guessed_s + min(max(dt, 0.0), motion_model.LONGEST_CARRY_S)
    t0, t1 = max(0.0, before - motion_model.LONGEST_CARRY_S), max(0.0, state.guessed_s - motion_model.LONGEST_CARRY_S)
    more = np.zeros((3, 3))
    more[:2, :2] = float(motion_model.UNSEEN[0]) ** 2 * (t1 * t1 - t0 * t0) * np.outer(loose, loose)
    state.P_anchor += more
    state.atlas.loosen(more, state.T_odom_anchor)  # the way too, or no loop could bring submaps together again


def noise_of(state: State, scan: Scan) -> float:
    """Range noise to reckon with: what residuals have shown, within a factor of three of the device's own figure."""
    stated = max(scan.sigma_m, LEAST_NOISE_M)
    return min(max(state.noise_m or stated, stated / 3.0, LEAST_NOISE_M), 3.0 * stated)


def learn_noise(state: State, match: MatchResult) -> None:
    """Follow the variance of the residuals."""
    square = match.residual_m**2 / CAUCHY
    if state.noise_m > 0.0:
        square = (1.0 - LEARNING) * state.noise_m**2 + LEARNING * square
    state.noise_m = float(np.sqrt(square))


def alike_of(state: State) -> float:
    """How many beams tell as much as one independent beam, by what residuals have shown."""
    return beams_each(*state.kinship.tolist())


def learn_alike(state: State, points: Array) -> None:
    """Follow how neighbouring residuals agree, from a scan that has just been matched: ``points`` (n, 4)."""
    if state.local is not None:
        gate = 3.0 * max(state.noise_m, LEAST_NOISE_M)
        found = agreement(points, state.local.axis, state.local.lines, state.fused.T_odom_base, gate)
        state.kinship = (1.0 - LEARNING) * state.kinship + LEARNING * found[:2]


def covariance(state: State) -> Array:
    """3x3 covariance of T_map_base: of the anchor, swung out to here, and of the pose relative to it.

    Once light has told where the map lies it is that of the place in the survey's frame instead.
    """
    out, yaw, tie, moving = np.empty((3, 3)), float(state.T_map_odom[2]), state.absolute, state.fused
    if tie is not None and tie.placed:
        turn(tie.P, yaw, out)
    else:
        hang(state.T_odom_anchor, moving.T_odom_base, state.P_anchor, moving.P, yaw, out)
    return out
