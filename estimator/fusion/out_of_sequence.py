"""Out-of-sequence scan: moves the state back to the instant of a late scan and re-propagates it after the match.

The pose's covariance is ``P_now = F P_then F' + Q``. The part that the motion since has added is subtracted and then
added again, so it counts once. ``X`` is the covariance of the survey alignment's error with the pose's. It has grown by
the same ``Q``, less the corrections by light since (`estimator.fusion.map_odom_filter`). A correction by the match then
applies to the present.
"""

from __future__ import annotations

import numpy as np

from estimator.fusion.map_pose import MapPose, SurveyAlignment
from estimator.fusion.motion_history import ANOTHER_CLOCK_S, LATE_S, Ahead, made, positive, turned
from estimator.fusion.motion_model import Motion
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import swing


def late(motion: Motion, scan: Scan) -> bool:
    """Whether the pose is ahead of the end of a scan by more than the variation of stamps."""
    return LATE_S < motion.t_mono - scan.t_end < ANOTHER_CLOCK_S


def too_old(motion: Motion, scan: Scan) -> bool:
    """Whether a scan ended before the motion history begins."""
    return late(motion, scan) and motion.trail.since(scan.t_end) is None


def go_back(pose: MapPose, motion: Motion, scan: Scan) -> Ahead:
    """Move the pose back to the end of a late scan within the history; returns the motion since."""
    alignment = pose.alignment
    way = motion.trail.since(scan.t_end)
    assert way is not None
    delta, Q = made(way)
    then = se2.compose(motion.T_odom_base, se2.inverse(delta))
    x, y, _ = (then - motion.T_odom_base).tolist()
    Q_odom = turned(Q, then[2])
    P = swung(x, y, motion.P - Q_odom)
    known = positive(P)
    both = shared(alignment, motion, scan.t_end, Q_odom) if known else Q_odom
    since = delta, Q, turned(both, -then[2])
    ahead = Ahead(motion.t_mono, *since, known, motion.velocity.copy(), motion.velocity_variance.copy())
    motion.P = P if known else swung(x, y, motion.P)
    if alignment is not None:
        alignment.P = swung(x, y, alignment.P)
        alignment.X = swung(x, y, alignment.X - both if known else alignment.X)
    motion.T_odom_base, motion.t_mono = then, scan.t_end
    return ahead


def come_again(pose: MapPose, motion: Motion, ahead: Ahead) -> None:
    """Re-propagate the corrected pose to the present.

    If there is odometry, it is newer than the match, and its velocity is restored.
    """
    alignment = pose.alignment
    then = motion.T_odom_base
    now = se2.compose(then, ahead.delta)
    x, y, _ = (now - then).tolist()
    Q_odom = turned(ahead.Q, then[2])
    motion.P = swung(x, y, motion.P) + Q_odom
    if alignment is not None:
        alignment.P = swung(x, y, alignment.P) + (0.0 if ahead.known else Q_odom)
        alignment.X = swung(x, y, alignment.X) + turned(ahead.shared, then[2])
    motion.T_odom_base, motion.t_mono = now, ahead.t_mono
    if motion.odometry:
        motion.velocity, motion.velocity_variance = ahead.velocity, ahead.velocity_variance


def shared(alignment: SurveyAlignment | None, motion: Motion, t_mono: float, Q: Array) -> Array:
    """Covariance of the alignment's error with ``Q``, which the motion since an instant has added to the pose's.

    It is all of ``Q`` except for the corrections by light on the way. All of it must not be subtracted after a second
    of light without scans. Each correction of the past pose would then move the map in the opposite direction.

    Args:
        alignment: with the survey frame, if there is one.
        motion: of the present pose.
        t_mono: the instant.
        Q: 3x3, odom axes, about the present position.
    """
    both, rest = np.zeros((3, 3)), Q
    for t_light, keep in () if alignment is None else alignment.mended:
        way = motion.trail.since(t_light) if t_light > t_mono else None
        if way is None:
            continue
        delta, Q_later = made(way)
        there = se2.compose(motion.T_odom_base, se2.inverse(delta))
        later, away = turned(Q_later, there[2]), motion.T_odom_base - there
        both, rest = se2.lever_matrix(away) @ keep @ se2.lever_matrix(-away) @ (both + rest - later), later
    return both + rest


def swung(x: float, y: float, P: Array) -> Array:
    """A covariance transformed along a lever arm, see `estimator.numerics.symmetric3.swing`."""
    P = np.array(P)
    swing(x, y, P)
    return P
