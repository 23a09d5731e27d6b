"""Scan-match update of the pose in the odom frame (Eq. 14-15), and learning of the range noise from residuals."""

from __future__ import annotations

import math

import numpy as np

from estimator.fusion import map_odom_filter, motion_model
from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_model import Motion, MotionNoise
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import informed
from estimator.result import MatchResult, Reason
from estimator.scan_matching.match_memory import MatchMemory
from estimator.scan_matching.residual_correlation import agreement, beams_each

LEAST_NOISE_M = 0.004
LEARNING = 0.02
HELD, HELD_YAW = 100.0, 830.0
"""Smallest information of a known direction, and of the heading: 10 cm, 2 deg (`MatchResult.known_axes`)."""
BLIND = (Reason.TOO_FEW_POINTS, Reason.MALFORMED, Reason.LATE, Reason.REPEATED, Reason.PASSED_OVER)
"""Results of a scan without usable data: they do not contradict the map."""
CAUCHY = 0.807
"""Share of a Gaussian's variance that remains under the robust weights of the matcher."""


def fuse(pose: MapPose, motion: Motion, matching: MatchMemory, match: MatchResult, noise: MotionNoise) -> Array | None:
    """Set the matched pose and add its information; without odometry the match also gives the velocity.

    The match has included the prediction already (Eq. 14), so its pose is the fused pose.

    Returns:
        Covariance (3, 3; odom axes) that the path to here gains from prediction along a degenerate direction, None for
            none.
    """
    more: Array | None = None
    if match.ok:
        matching.failures, matching.t_match = 0, motion.t_mono
        learn_noise(matching, match)
        T_pred, P_pred = motion.T_odom_base, motion.P
        motion.T_odom_base = matching.T_odom_match = match.T_odom_base
        lacked = motion_model.learn(motion, match.correction, match.information, bool(match.known_axes.all()))
        motion.P = updated(P_pred + lacked, match.information, motion.odometry)
        map_odom_filter.on_match(pose, motion, matching.t_scan, (T_pred, P_pred), lacked)
        if matching.t_scan > -np.inf:
            made, dt = se2.between(matching.T_odom_scan, motion.T_odom_base), motion.t_mono - matching.t_scan
            motion.gyro.learn(float(made[2]), dt)
            interval = (matching.t_scan, motion.t_mono)
            motion_model.feel(motion, made, interval, 2.0 * motion.P.diagonal(), noise)
            more = unheld(matching, motion, match.information, dt)
            if more is not None:
                pose.P_anchor += more
    elif match.reason is not Reason.NO_MAP:
        matching.failures += match.reason not in BLIND  # a scan without usable data does not contradict the map
        if not motion.odometry:
            motion_model.slow_down(motion)
    matching.t_scan, matching.T_odom_scan = motion.t_mono, motion.T_odom_base
    return more


def updated(P: Array, H: Array, odometry: bool) -> Array:
    """Covariance (3, 3) of a prediction ``P`` after a match with information ``H``.

    A degenerate direction of the match gains no information. In a corridor the known direction varies slightly from
    scan to scan. A tenth of a degree, forty times a second, would add up to centimetres of false knowledge along the
    corridor. Without ``odometry`` there is no other source: see :func:`unheld`.
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
    """Unit vector (x, y) along which information ``H`` (3, 3) leaves the position unknown, None if there is none."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = H.tolist()
    tt = max(tt, 1e-9)
    xx, xy, yy = xx - xt * xt / tt, xy - xt * yt / tt, yy - yt * yt / tt
    half = 0.5 * math.atan2(2.0 * xy, xx - yy)
    x, y = -math.sin(half), math.cos(half)
    return np.array((x, y)) if x * x * xx + 2.0 * x * y * xy + y * y * yy < HELD else None


def unheld(matching: MatchMemory, motion: Motion, H: Array, dt: float) -> Array | None:
    """Covariance (3, 3; odom axes) that the position in the map gains along a degenerate direction; None: none.

    Without odometry the constant velocity alone predicts the pose along such a direction, and no match can correct it.
    Its error grows with the distance. The map created meanwhile keeps that error for good, so the covariance of the
    position in the map grows. It grows at walking speed, from half a second on. A gap in the lidar data has already
    enlarged the prediction's own covariance.
    """
    loose = loose_direction(H)
    if motion.odometry or loose is None:
        matching.unheld_s = 0.0
        return None
    longest, before = motion_model.LONGEST_CARRY_S, matching.unheld_s
    matching.unheld_s += min(max(dt, 0.0), longest)
    t0, t1 = max(0.0, before - longest), max(0.0, matching.unheld_s - longest)
    more = np.zeros((3, 3))
    more[:2, :2] = float(motion_model.UNSEEN[0]) ** 2 * (t1 * t1 - t0 * t0) * np.outer(loose, loose)
    return more


def noise_of(matching: MatchMemory, scan: Scan) -> float:
    """Assumed range noise, m: as learned from residuals, within a factor of three of the device's own figure."""
    stated = max(scan.sigma_m, LEAST_NOISE_M)
    return min(max(matching.noise_m or stated, stated / 3.0, LEAST_NOISE_M), 3.0 * stated)


def learn_noise(matching: MatchMemory, match: MatchResult) -> None:
    """Update the exponentially weighted variance of the residuals."""
    square = match.residual_m**2 / CAUCHY
    if matching.noise_m > 0.0:
        square = (1.0 - LEARNING) * matching.noise_m**2 + LEARNING * square
    matching.noise_m = float(np.sqrt(square))


def beams_per_sample(matching: MatchMemory) -> float:
    """Beams per independent measurement, from the correlation of residuals."""
    return beams_each(*matching.residual_sums.tolist())


def learn_correlation(matching: MatchMemory, points: Array, T_odom_base: Array) -> None:
    """Update the correlation of neighbouring residuals from a scan that has just been matched: ``points`` (n, 4)."""
    local = matching.local_map
    if local is not None:
        gate = 3.0 * max(matching.noise_m, LEAST_NOISE_M)
        found = agreement(points, local.axis, local.lines, T_odom_base, gate)
        matching.residual_sums = (1.0 - LEARNING) * matching.residual_sums + LEARNING * found[:2]
