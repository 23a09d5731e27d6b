"""A scan that comes late: the state is taken back to where the robot was when it was true, and carried on again.

Of the pose's covariance ``P_now = F P_then F' + Q`` the part that the way since has added is taken out and put back, so
it is neither counted twice nor forgotten; the covariance ``X`` of the tie's error with the pose's has grown by the same
``Q``, less what light has mended since (`estimator.fusion.map_odom_filter`). What a match corrects then, it corrects
now.
"""

from __future__ import annotations

import numpy as np

from estimator.fusion.motion_history import ANOTHER_CLOCK_S, LATE_S, Ahead, made, positive, turned
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import swing
from estimator.state import State


def late(state: State, scan: Scan) -> bool:
    """Whether the pose has been carried on beyond the end of a scan by more than stamps are uneven."""
    return LATE_S < state.fused.t_mono - scan.t_end < ANOTHER_CLOCK_S


def too_old(state: State, scan: Scan) -> bool:
    """Whether a scan ended so long before the present pose that nobody knows any more where that was."""
    return late(state, scan) and state.fused.trail.since(scan.t_end) is None


def go_back(state: State, scan: Scan) -> Ahead:
    """Bring the pose back to where it was when a late scan ended, one that is not too old."""
    moving, tie = state.fused, state.absolute
    way = moving.trail.since(scan.t_end)
    assert way is not None
    delta, Q = made(way)
    then = se2.compose(moving.T_odom_base, se2.inverse(delta))
    x, y, _ = (then - moving.T_odom_base).tolist()
    Q_odom = turned(Q, then[2])
    P = swung(x, y, moving.P - Q_odom)
    known = positive(P)
    both = shared(state, scan.t_end, Q_odom) if known else Q_odom
    ahead = Ahead(
        moving.t_mono,
        delta,
        Q,
        turned(both, -then[2]),
        known,
        moving.velocity.copy(),
        moving.velocity_variance.copy(),
    )
    moving.P = P if known else swung(x, y, moving.P)
    if tie is not None:
        tie.P = swung(x, y, tie.P)
        tie.X = swung(x, y, tie.X - both if known else tie.X)
    moving.T_odom_base, moving.t_mono = then, scan.t_end
    return ahead


def come_again(state: State, ahead: Ahead) -> None:
    """Carry the pose on again to where it is now; of the velocity, odometry has told later than the match."""
    moving, tie = state.fused, state.absolute
    then = moving.T_odom_base
    now = se2.compose(then, ahead.delta)
    x, y, _ = (now - then).tolist()
    Q_odom = turned(ahead.Q, then[2])
    moving.P = swung(x, y, moving.P) + Q_odom
    if tie is not None:
        tie.P = swung(x, y, tie.P) + (0.0 if ahead.known else Q_odom)
        tie.X = swung(x, y, tie.X) + turned(ahead.shared, then[2])
    moving.T_odom_base, moving.t_mono = now, ahead.t_mono
    if moving.odometry:
        moving.velocity, moving.velocity_variance = ahead.velocity, ahead.velocity_variance


def shared(state: State, t_mono: float, Q: Array) -> Array:
    """Covariance of the tie's error with ``Q``, what the way since an instant has added to the pose's.

    All of it, but for what light has mended on the way. Taken out whole where a robot had light and no scans for a
    second, it left a pose of then that had to move the map against each of its own corrections.

    Args:
        state: all of the estimator.
        t_mono: the instant.
        Q: 3x3, odom axes, about the place of now.
    """
    moving, tie = state.fused, state.absolute
    both, rest = np.zeros((3, 3)), Q
    for t_light, keep in () if tie is None else tie.mended:
        way = moving.trail.since(t_light) if t_light > t_mono else None
        if way is None:
            continue
        delta, Q_later = made(way)
        there = se2.compose(moving.T_odom_base, se2.inverse(delta))
        later, away = turned(Q_later, there[2]), moving.T_odom_base - there
        both, rest = se2.lever_matrix(away) @ keep @ se2.lever_matrix(-away) @ (both + rest - later), later
    return both + rest


def swung(x: float, y: float, P: Array) -> Array:
    """A covariance carried along a lever arm, see `estimator.numerics.symmetric3.swing`."""
    P = np.array(P)
    swing(x, y, P)
    return P
