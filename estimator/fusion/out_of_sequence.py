"""A scan that comes late: the state is taken back to where the robot was when it was true, and carried on again.

Of the pose's covariance ``P_now = F P_then F' + Q`` the part that the way since has added is taken out and put back, so
it is neither counted twice nor forgotten. The covariance ``X`` of the survey alignment's error with the pose's has
grown by the same ``Q``, less what light has corrected since (`estimator.fusion.map_odom_filter`). What a match corrects
then, it corrects now.
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
    """Whether the pose has been carried on beyond the end of a scan by more than stamps are uneven."""
    return LATE_S < motion.t_mono - scan.t_end < ANOTHER_CLOCK_S


def too_old(motion: Motion, scan: Scan) -> bool:
    """Whether a scan ended so long before the present pose that nobody knows any more where that was."""
    return late(motion, scan) and motion.trail.since(scan.t_end) is None


def go_back(pose: MapPose, motion: Motion, scan: Scan) -> Ahead:
    """Bring the pose back to where it was when a late scan ended, one that is not too old."""
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
    ahead = Ahead(
        motion.t_mono,
        delta,
        Q,
        turned(both, -then[2]),
        known,
        motion.velocity.copy(),
        motion.velocity_variance.copy(),
    )
    motion.P = P if known else swung(x, y, motion.P)
    if alignment is not None:
        alignment.P = swung(x, y, alignment.P)
        alignment.X = swung(x, y, alignment.X - both if known else alignment.X)
    motion.T_odom_base, motion.t_mono = then, scan.t_end
    return ahead


def come_again(pose: MapPose, motion: Motion, ahead: Ahead) -> None:
    """Re-propagate the corrected pose to the present.

    Odometry is newer than the match: the velocity by it is restored.
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
    """Covariance of the alignment's error with ``Q``, what the way since an instant has added to the pose's.

    All of it, but for what light has mended on the way. Taken out whole where a robot had light and no scans for a
    second, it left a pose of then that had to move the map against each of its own corrections.

    Args:
        alignment: with the survey's frame, if there is one.
        motion: of the present pose.
        t_mono: the instant.
        Q: 3x3, odom axes, about the place of now.
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
    """A covariance carried along a lever arm, see `estimator.numerics.symmetric3.swing`."""
    P = np.array(P)
    swing(x, y, P)
    return P
