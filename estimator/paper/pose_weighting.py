"""Weighted combination of the poses T1 and T2 (Eq. 14-15) on the group of rigid motions.

Eq. 14 reads ``T_k = w T1 + (1 - w) T2``. A sum of two homogeneous matrices is no rigid motion. So the combination is
taken along the geodesic between them: ``T_k = T2 Exp(W Log(T2^-1 T1))``; ``W = 0`` is T2, ``W = 1`` is T1.
:class:`Weight` has two forms of W, after Eq. 15.

T1 comes from odometry and lamps (`light_pose`), T2 from the lidar alone. A `MatchResult` contains the lidar's
information only. The daemon's matcher has the prediction as a prior inside its normal equations. Their solution is this
combination, with the matrix weight, to first order.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel
from estimator.numerics.symmetric3 import invert3


class Weight(Enum):
    """Form of the weight of T1 against T2 (Eq. 15) in the paper's matcher."""

    INFORMATION = "matrix (L1 + L2)^-1 L1: each direction from the estimate that knows it"
    PAPER = "scalar ratio of the probabilities of both measurements at the present pose, in each iteration"


@kernel("void(f8[::1], f8[::1], f8[::1])")
def twist_between(A: Array, B: Array, out: Array) -> None:
    """Write ``Log(A^-1 B)``: the body twist (m, m, rad) from pose A to pose B."""
    yaw = B[2] - A[2]
    yaw -= 2.0 * np.pi * np.floor(yaw / (2.0 * np.pi) + 0.5)
    c, s = np.cos(A[2]), np.sin(A[2])
    dx, dy = B[0] - A[0], B[1] - A[1]
    x, y = c * dx + s * dy, c * dy - s * dx
    half = 0.5 * yaw
    k = 1.0 - half * half / 3.0 if abs(yaw) < 1e-4 else half / np.tan(half)
    out[0], out[1], out[2] = k * x + half * y, k * y - half * x, yaw


@kernel("void(f8[::1], f8[::1], f8[::1])")
def moved(A: Array, twist: Array, out: Array) -> None:
    """Write ``A Exp(twist)``; ``out`` may be ``A``. Yaw is not wrapped."""
    w = twist[2]
    a = 1.0 - w * w / 6.0 if abs(w) < 1e-4 else np.sin(w) / w
    b = 0.5 * w if abs(w) < 1e-4 else (1.0 - np.cos(w)) / w
    x, y = a * twist[0] - b * twist[1], b * twist[0] + a * twist[1]
    c, s = np.cos(A[2]), np.sin(A[2])
    out[0], out[1], out[2] = A[0] + c * x - s * y, A[1] + s * x + c * y, A[2] + w


@kernel("void(f8[::1], f8[::1], f8[:, ::1], f8[::1])")
def combine(T1: Array, T2: Array, W: Array, out: Array) -> None:
    """Eq. 14 on SE(2): ``T2 Exp(W Log(T2^-1 T1))``; the weight (3, 3) is in the axes of T2's own frame."""
    d, u = np.empty(3), np.empty(3)
    twist_between(T2, T1, d)
    for i in range(3):
        u[i] = W[i, 0] * d[0] + W[i, 1] * d[1] + W[i, 2] * d[2]
    moved(T2, u, out)


@kernel("void(f8[:, ::1], f8, f8[:, ::1])")
def turned(L: Array, yaw: float, out: Array) -> None:
    """Write ``R' L R``: information (3, 3) in the axes of a frame that has yaw ``yaw`` in the present one."""
    c, s = np.cos(yaw), np.sin(yaw)
    x0, y0, x1, y1, x2, y2 = L[0, 0], L[0, 1], L[1, 0], L[1, 1], L[2, 0], L[2, 1]
    a0, b0 = c * x0 + s * y0, c * y0 - s * x0
    a1, b1 = c * x1 + s * y1, c * y1 - s * x1
    out[0, 0], out[0, 1] = c * a0 + s * a1, c * b0 + s * b1
    out[1, 0], out[1, 1] = c * a1 - s * a0, c * b1 - s * b0
    out[2, 0] = out[0, 2] = c * x2 + s * y2
    out[2, 1] = out[1, 2] = c * y2 - s * x2
    out[2, 2] = L[2, 2]


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def information_weight(L1: Array, L2: Array, W: Array) -> None:
    """Eq. 15 as a matrix: ``W = (L1 + L2)^-1 L1``; both (3, 3) in the axes of T2's frame."""
    P = invert3(L1 + L2)
    for i in range(3):
        for j in range(3):
            W[i, j] = P[i, 0] * L1[0, j] + P[i, 1] * L1[1, j] + P[i, 2] * L1[2, j]


@kernel("void(f8, f8, f8[:, ::1])")
def paper_weight(log1: float, log2: float, W: Array) -> None:
    """Eq. 15 as a scalar: ``p1 / (p1 + p2)`` times the unit matrix, from the logarithms of ``rho_j p_j``.

    The integrals of Eq. 15 cannot be taken literally: with ``p`` normalised they are constants. The comparison uses
    their integrand at the present pose. Both logarithms are means over the measurements of their kind. So a thousand
    beams do not outweigh eight lamps by number alone. ``rho_j`` makes them 0 for a perfect measurement.
    """
    d = min(max(log2 - log1, -700.0), 700.0)
    W[:] = 0.0
    W[0, 0] = W[1, 1] = W[2, 2] = 1.0 / (1.0 + np.exp(d))
