"""Kernels for the 3x3 covariance of a pose: prediction, lever arm, rotation, measurement update.

A cycle does some dozens of these operations. Each is one kernel, because calling numpy for each 3x3 product costs more
than all the arithmetic. In `grow_tie` and `mend_tie`, ``P`` is the covariance of ``T_map_base``. ``X`` is its
cross-covariance with the error of ``T_odom_base``; see `estimator.fusion.map_odom_filter`.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel
from estimator.numerics.symmetric3 import add_turned, invert3, largest_of, swing


@kernel("void(f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1])")
def carry_on(T: Array, delta: Array, variance: Array, P: Array, T_out: Array, P_out: Array) -> None:
    """Predict a pose and its covariance over the motion ``delta``, given in the frame of the pose (m, m, rad).

    The noise acts in the axes of the pose half way through the turn.

    Args:
        T: (3,) pose before.
        delta: (3,) motion.
        variance: (3,) variance of the motion (x, y, yaw).
        P: 3x3 covariance of the pose, in the axes of its parent frame.
        T_out: (3,) out: pose after.
        P_out: 3x3 out: covariance after.
    """
    c, s = np.cos(T[2]), np.sin(T[2])
    x, y = c * delta[0] - s * delta[1], s * delta[0] + c * delta[1]
    P_out[:] = P
    swing(x, y, P_out)
    add_turned(T[2] + 0.5 * delta[2], variance, P_out)
    yaw = T[2] + delta[2]
    T_out[0], T_out[1] = T[0] + x, T[1] + y
    T_out[2] = (yaw + np.pi) % (2.0 * np.pi) - np.pi


@kernel("void(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], UniTuple(f8, 2))")
def feel_axes(
    velocity: Array, spread: Array, made: Array, variance: Array, unknown: Array, span: tuple[float, float]
) -> None:
    """Scalar Kalman update of each velocity component, in place; see `estimator.fusion.motion_model.feel`.

    Args:
        velocity: (3,) velocity (m/s, m/s, rad/s), updated.
        spread: (3,) its variances, updated.
        made: (3,) twist over the interval.
        variance: (3,) variance of the twist.
        unknown: (3,) variance of the acceleration.
        span: length of the interval; time since the last velocity update, both in s.
    """
    dt, late = span
    for axis in range(3):
        P = spread[axis] + unknown[axis] * late * late
        gain = P / (P + variance[axis] / (dt * dt) + unknown[axis] * (0.25 * dt * dt))
        velocity[axis] += gain * (made[axis] / dt - velocity[axis])
        spread[axis] = (1.0 - gain) * P


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1])")
def grow_tie(P: Array, X: Array, before: Array, after: Array, made: Array, out: Array) -> None:
    """Predict the covariances ``P`` and ``X`` of the map-odom filter over a motion of the base.

    Both rotate about the lever arm of the motion, and both receive the process noise of the odom pose.

    Args:
        P: 3x3, see `estimator.fusion.map_odom_filter`.
        X: 3x3, likewise.
        before: 3x3 covariance of the odom pose before the motion.
        after: 3x3 covariance of the odom pose after the motion.
        made: (5,) x and y of the motion in the parent's axes; drift noise for the diagonal of ``P``.
        out: (2, 3, 3) out: the new P and X.
    """
    x, y = made[0], made[1]
    carried = before.copy()
    out[0], out[1] = P, X
    swing(x, y, carried)
    swing(x, y, out[0])
    swing(x, y, out[1])
    for i in range(3):
        for j in range(3):
            Q = after[i, j] - carried[i, j]
            out[0, i, j] += Q
            out[1, i, j] += Q
        out[0, i, i] += made[2 + i]


@kernel("void(f8[:, ::1], f8, f8[:, ::1])")
def turn(P: Array, yaw: float, out: Array) -> None:
    """``R P R'``: rotate a covariance (x, y, yaw) by ``yaw``, into axes that are turned by ``-yaw`` from its own."""
    c, s = np.cos(yaw), np.sin(yaw)
    for j in range(3):
        out[0, j] = c * P[0, j] - s * P[1, j]
        out[1, j] = s * P[0, j] + c * P[1, j]
        out[2, j] = P[2, j]
    for i in range(3):
        x, y = out[i, 0], out[i, 1]
        out[i, 0], out[i, 1] = c * x - s * y, s * x + c * y


@kernel("void(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8, f8[:, ::1])")
def hang(T_anchor: Array, T: Array, P_anchor: Array, P: Array, yaw: float, out: Array) -> None:
    """Covariance of a pose that is relative to an uncertain anchor, rotated by ``yaw``.

    The anchor's covariance acts through the lever arm from the anchor to the pose. The relative covariance is added.

    Args:
        T_anchor: (3,) pose of the anchor.
        T: (3,) the pose, in the same frame.
        P_anchor: 3x3 covariance of the anchor.
        P: 3x3 covariance of the pose relative to the anchor.
        yaw: rotation of the result; its axes are turned by ``-yaw`` from that frame's, rad.
        out: 3x3 out.
    """
    here = P_anchor.copy()
    swing(T[0] - T_anchor[0], T[1] - T_anchor[1], here)
    for i in range(3):
        for j in range(3):
            here[i, j] += P[i, j]
    turn(here, yaw, out)


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])", inner=True)
def times(A: Array, B: Array, out: Array) -> None:
    """Product of two 3x3 matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


MOST = 0.999
"""Largest share of the covariance ``P`` that the odom error may explain. A larger share is a rounding error and might
leave a negative variance.
"""


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])", inner=True)
def no_more(P: Array, X: Array, K: Array) -> None:
    """Limit the gain ``K = X W^-1``, in place, so that the covariance it explains stays below ``P``.

    The explained covariance is ``K W K' = X K'``.
    """
    explained = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            explained[i, j] = 0.0
            for k in range(3):
                explained[i, j] += 0.5 * (X[i, k] * K[j, k] + X[j, k] * K[i, k])
    most = largest_of(invert3(P), explained)
    if most > MOST:
        for i in range(3):
            for j in range(3):
                K[i, j] *= np.sqrt(MOST / most)


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1])")
def mend_tie(P: Array, X: Array, more: Array, before: Array, after: Array, out: Array) -> None:
    """Update the covariances ``P`` and ``X`` of the map-odom filter after a scan match.

    The match reduced the covariance of the odom pose from ``before`` to ``after``. The gain is limited (`no_more`), so
    that no match removes more covariance than there is. Late scans with light updates in between may have left too
    large an ``X``. A negative variance would end the daemon where its square root is taken.

    Args:
        P: 3x3 covariance.
        X: 3x3 cross-covariance with the odom pose.
        more: 3x3 inflation that is first added to both and to ``before``.
        before: 3x3 covariance of the odom pose before the match.
        after: 3x3 covariance of the odom pose after the match.
        out: (3, 3, 3) out: the new P and X, and the gain from the match's correction to the error of ``P``.
    """
    wide, gained, part = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            wide[i, j] = before[i, j] + more[i, j]
            out[0, i, j] = P[i, j] + more[i, j]
            out[1, i, j] = X[i, j] + more[i, j]
            gained[i, j] = wide[i, j] - after[i, j]
    times(out[1], invert3(wide), out[2])
    no_more(out[0], out[1], out[2])
    times(out[2], gained, part)
    for i in range(3):
        for j in range(3):
            lost = 0.0
            for k in range(3):
                lost += part[i, k] * out[2, j, k]
            wide[i, j] = out[0, i, j] - lost
    for i in range(3):
        for j in range(3):
            out[0, i, j] = 0.5 * (wide[i, j] + wide[j, i])
    times(out[2], after, out[1])


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def informed(P: Array, H: Array, out: Array) -> None:
    """``(P^-1 + H)^-1``: covariance after an update with information ``H``; see `symmetric3.invert3`."""
    L = invert3(P)
    for i in range(3):
        for j in range(3):
            L[i, j] += H[i, j]
    out[:] = invert3(L)
