"""Kernels of the pose's covariance: carried along a motion, tied to the survey, mended by a match.

In one kernel each, because a cycle does some dozens of such things to 3x3 matrices, and calling numpy for each product
costs more than all the arithmetic.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel
from estimator.numerics.symmetric3 import add_turned, invert3, largest_of, swing


@kernel("void(f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[:, ::1])")
def carry_on(T: Array, delta: Array, variance: Array, P: Array, T_out: Array, P_out: Array) -> None:
    """Move a pose by ``delta`` in its own frame, with noise of ``variance`` (x, y, yaw) in the axes half way.

    Args:
        T: pose before.
        delta: the motion.
        variance: (3,) of it.
        P: 3x3, of the pose, in the axes of its parent frame.
        T_out: pose after, out.
        P_out: its covariance, out.
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
    """A scalar Kalman filter for each component of the velocity, in place; see `estimator.fusion.motion_model.feel`.

    Args:
        velocity: (3,), changed.
        spread: (3,) its variances, changed.
        made: (3,) twist over the interval.
        variance: (3,) of it.
        unknown: (3,) variance of the acceleration.
        span: length of the interval; how long ago the velocity was last felt.
    """
    dt, late = span
    for axis in range(3):
        P = spread[axis] + unknown[axis] * late * late
        gain = P / (P + variance[axis] / (dt * dt) + unknown[axis] * (0.25 * dt * dt))
        velocity[axis] += gain * (made[axis] / dt - velocity[axis])
        spread[axis] = (1.0 - gain) * P


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1])")
def grow_tie(P: Array, X: Array, before: Array, after: Array, made: Array, out: Array) -> None:
    """The tie's covariances after a motion: swung along, with the noise that the motion has added to the pose's own.

    Args:
        P: of the tie, see `estimator.fusion.map_odom_filter`.
        X: likewise.
        before: 3x3 of the pose.
        after: the same after the motion.
        made: (5,) x and y of the motion in the parent's axes, and what drift adds to the diagonal of ``P``.
        out: (2, 3, 3) the new P and X.
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
    """``R P R'``: a covariance (x, y, yaw) in axes that are turned by ``-yaw`` against its own."""
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
    """Covariance of a pose that hangs on an anchor, turned by ``yaw``: the anchor's own, swung out, and the rest.

    Args:
        T_anchor: place of the anchor.
        T: of the pose, in the same frame.
        P_anchor: of the anchor.
        P: of the pose relative to it.
        yaw: by which the axes of the outcome are turned back against that frame's.
        out: 3x3.
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
"""Share of the tie's error that may be the pose's too; more is rounding's, and might leave a negative variance."""


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])", inner=True)
def no_more(P: Array, X: Array, K: Array) -> None:
    """Scale the share ``K = X W^-1`` so that ``K W K' = X K'``, what it explains of ``P``, leaves something of it."""
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
    """The tie's covariances after a match that has brought the pose's own from ``before`` to ``after``.

    No match takes more from the tie's error than there is: scans that came late, with light in between, may have left
    an ``X`` that says so, and a negative variance would end the daemon where its root is taken.

    Args:
        P: of the tie.
        X: likewise.
        more: what these and ``before`` are raised by first.
        before: 3x3 of the pose.
        after: the same after the match.
        out: (3, 3, 3) the new P and X, and the share of the match's correction that the tie's error takes.
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
    """``(P^-1 + H)^-1``, see `estimator.numerics.symmetric3.invert3`."""
    L = invert3(P)
    for i in range(3):
        for j in range(3):
            L[i, j] += H[i, j]
    out[:] = invert3(L)
