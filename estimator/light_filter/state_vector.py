"""State vector of the light filter and its time update (Eq. 5-7), compiled.

One float64 vector with its covariance; only the first ``15 + 4 * slots`` elements are in use:

=====  ==========================================================================================================
0-2    x, y, yaw of the base in the map (m, rad)
3-5    forward and sideways speed, yaw rate in the base frame; only while no odometry arrives
6-9    errors of motion sensing: ln scale of the path, share of the turn, rad per metre (odometry); rad/s (gyro bias)
10     common ln gain: dirt on the receiver, supply voltage, its own gain
11     ln of the diffuse floor
12-13  the receiver's tilt beyond calibration (slopes in base_link)
14     the receiver's Lambert order beyond calibration: absorbs departures of lamps and receiver from cosines
15..   four per lamp: its ln gain, its tilt beyond the survey (two slopes), its present model error
=====  ==========================================================================================================

A lamp's tilt also absorbs an asymmetric pattern. Model errors come from walls, a luminaire that is not Lambertian, or
darker ground. They are constant at rest and change as the robot drives on. Each is a state of unit variance that fades
with the path length; the model's sigma scales it per link. Twenty epochs a second of the same error therefore do not
count as twenty measurements.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

X, Y, YAW, SPEED, SIDE, TURN = range(6)
SCALE, TURN_SCALE, CURVE, GYRO, COMMON, FLOOR, LEAN_X, LEAN_Y, ORDER, FIRST = range(6, 16)
"""Indices in the state."""
OWN: Final = 4
GAIN, TILT_X, TILT_Y, ERROR = range(OWN)
"""Elements of the lamp in slot k, from ``FIRST + OWN * k`` on."""

SLOTS: Final = 24
"""Most lamps with states at once; more than a receiver with 120 deg of view uses in a 2.5 m grid."""
SIZE: Final = FIRST + OWN * SLOTS


@kernel("void(f8[::1], f8[:, ::1], i8, f8[:, ::1], f8[:, ::1])", inner=True)
def propagate(x: Array, P: Array, n: int, F: Array, Q: Array) -> None:
    """``P <- F P F' + Q`` where F differs from the identity in its first three rows only.

    Args:
        x: state; only its length matters here.
        P: covariance, changed in place.
        n: elements in use.
        F: (3, n) or wider, the first three rows of the transition.
        Q: (3, 3) noise of the pose.
    """
    T = np.empty((3, x.shape[0]))
    for r in range(3):
        for j in range(n):
            total = 0.0
            for k in range(FIRST):
                total += F[r, k] * P[k, j]
            T[r, j] = total
    for r in range(3):
        for j in range(3, n):
            P[r, j] = P[j, r] = T[r, j]
    for r in range(3):
        for s in range(r, 3):
            total = 0.5 * (Q[r, s] + Q[s, r])
            for k in range(FIRST):
                total += 0.5 * (T[r, k] * F[s, k] + T[s, k] * F[r, k])
            P[r, s] = P[s, r] = total


@kernel("void(f8[::1], f8[:, ::1], i8, f8[::1], f8[::1], f8[::1])")
def move(x: Array, P: Array, n: int, delta: Array, blame: Array, noise: Array) -> None:
    """Move the pose by an increment in the base frame, corrected by the estimated sensor errors.

    Args:
        x: state, changed in place.
        P: its covariance, changed in place.
        n: elements in use.
        delta: (dx, dy, dyaw) as measured; all zero with constant velocity.
        blame: (7,) derivatives of the motion by speed, sideways speed, yaw rate (s, s, s), turn share (rad), curve (m),
            gyro bias (-s), scale (1 or 0).
        noise: (3,) variances along, across, of the turn.
    """
    c, s = np.cos(x[YAW]), np.sin(x[YAW])
    scale = 1.0 + blame[6] * x[SCALE]
    add = blame[2] * x[TURN] + blame[3] * x[TURN_SCALE] + blame[4] * x[CURVE] + blame[5] * x[GYRO]
    u, v = scale * delta[0] + blame[0] * x[SPEED], scale * delta[1] + blame[1] * x[SIDE]
    h = 0.5 * add  # the displacement turns by half the correction
    ux, uy = c * u - s * v, s * u + c * v
    wx, wy = ux - h * uy, uy + h * ux
    ex, ey = c - h * s, s + h * c
    F = np.zeros((3, FIRST))
    F[0, X] = F[1, Y] = F[2, YAW] = 1.0
    F[0, YAW], F[1, YAW] = -wy, wx
    F[0, SPEED], F[1, SPEED] = blame[0] * ex, blame[0] * ey
    F[0, SIDE], F[1, SIDE] = -blame[1] * ey, blame[1] * ex
    F[0, SCALE], F[1, SCALE] = blame[6] * (ex * delta[0] - ey * delta[1]), blame[6] * (ey * delta[0] + ex * delta[1])
    F[2, TURN], F[2, TURN_SCALE], F[2, CURVE], F[2, GYRO] = blame[2], blame[3], blame[4], blame[5]
    for k in (TURN, TURN_SCALE, CURVE, GYRO):
        F[0, k], F[1, k] = -0.5 * uy * F[2, k], 0.5 * ux * F[2, k]
    Q = np.zeros((3, 3))
    Q[0, 0] = c * c * noise[0] + s * s * noise[1]
    Q[1, 1] = s * s * noise[0] + c * c * noise[1]
    Q[0, 1] = Q[1, 0] = c * s * (noise[0] - noise[1])
    Q[2, 2] = noise[2]
    propagate(x, P, n, F, Q)
    x[X] += wx
    x[Y] += wy
    turned = x[YAW] + delta[2] + add
    x[YAW] = (turned + np.pi) % (2.0 * np.pi) - np.pi


@kernel("void(f8[::1], f8[:, ::1], i8, f8[::1], f8[::1])")
def fade(x: Array, P: Array, n: int, keep: Array, grow: Array) -> None:
    """Decay and process noise: scale element j by ``keep[j]``, add variance ``grow[j]`` (both (n,) or longer)."""
    for j in range(n):
        if keep[j] != 1.0:
            x[j] *= keep[j]
            for k in range(n):
                P[j, k] *= keep[j]
            for k in range(n):
                P[k, j] *= keep[j]
        P[j, j] += grow[j]


@kernel("void(f8[:, ::1], i8, i8)")
def cut(P: Array, n: int, j: int) -> None:
    """Remove the covariance of element ``j`` with the others (before it is given a new meaning)."""
    for k in range(n):
        if k != j:
            P[j, k] = P[k, j] = 0.0
