"""Symmetric 3x3 linear algebra in kernels: solve, invert, eigenvalues, lever arm of a covariance."""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

TINY = 1e-9
"""Added to a diagonal, so that the inverse stays finite. Its sigma (0.03 mm) is below any that matters."""


@kernel("f8(f8[:, ::1], f8[::1], f8[::1])", inner=True)
def solve3(A: Array, b: Array, x: Array) -> float:
    """Solve a symmetric positive definite system by Cramer's rule; returns the determinant (x = 0 if not positive)."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    c01 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    c02 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    det: float = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    x[:] = 0.0
    if not det > 0.0:
        return 0.0
    c11 = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    c12 = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    c22 = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / det
    x[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / det
    x[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / det
    return det


@kernel("b1(f8[:, ::1])", inner=True)
def positive(A: Array) -> bool:
    """Whether a symmetric matrix is positive definite (Sylvester's leading minors)."""
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    det = (
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2])
        - A[0, 1] * (A[0, 1] * A[2, 2] - A[1, 2] * A[0, 2])
        + A[0, 2] * (A[0, 1] * A[1, 2] - A[1, 1] * A[0, 2])
    )
    return bool(A[0, 0] > 0.0 and minor > 0.0 and det > 0.0)


@kernel("void(f8[:, ::1], f8[:, ::1])", inner=True)
def eigen3(A: Array, V: Array) -> None:
    """Diagonalise a symmetric matrix in place by Jacobi rotations; the columns of ``V`` are its eigenvectors."""
    V[:] = 0.0
    V[0, 0] = V[1, 1] = V[2, 2] = 1.0
    for _ in range(8):
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                angle = 0.5 * np.arctan2(2.0 * A[p, q], A[q, q] - A[p, p])
                c, s = np.cos(angle), np.sin(angle)
                for k in range(3):
                    x, y = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = A[p, k], A[q, k]
                    A[p, k], A[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * x - s * y, s * x + c * y


@kernel("f8[:, ::1](f8[:, ::1])")
def invert3(A: Array) -> Array:
    """Inverse of a symmetric positive matrix, regularised by `TINY` on the diagonal, so that it always exists.

    Converts covariance to information and back. The matrix is scaled to a unit diagonal, because metres and radians may
    differ widely.
    """
    B = np.empty((3, 3))
    scale = np.empty(3)
    for i in range(3):
        scale[i] = 1.0 / np.sqrt(max(A[i, i], 0.0) + TINY)
    for i in range(3):
        for j in range(3):
            B[i, j] = A[i, j] * scale[i] * scale[j]
        B[i, i] = 1.0
    out = np.empty((3, 3))
    out[0, 0] = B[1, 1] * B[2, 2] - B[1, 2] * B[1, 2]
    out[1, 1] = B[0, 0] * B[2, 2] - B[0, 2] * B[0, 2]
    out[2, 2] = B[0, 0] * B[1, 1] - B[0, 1] * B[0, 1]
    out[0, 1] = out[1, 0] = B[0, 2] * B[1, 2] - B[0, 1] * B[2, 2]
    out[0, 2] = out[2, 0] = B[0, 1] * B[1, 2] - B[0, 2] * B[1, 1]
    out[1, 2] = out[2, 1] = B[0, 1] * B[0, 2] - B[0, 0] * B[1, 2]
    det = max(B[0, 0] * out[0, 0] + B[0, 1] * out[0, 1] + B[0, 2] * out[0, 2], TINY)
    for i in range(3):
        for j in range(3):
            out[i, j] *= scale[i] * scale[j] / det
    return out


@kernel("f8[:, ::1](f8[:, ::1])")
def positive_part(A: Array) -> Array:
    """Nearest symmetric matrix without negative eigenvalues."""
    B, V, out = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            B[i, j] = 0.5 * (A[i, j] + A[j, i])
    eigen3(B, V)
    for k in range(3):
        for i in range(3):
            for j in range(3):
                out[i, j] += V[i, k] * max(B[k, k], 0.0) * V[j, k]
    return out


@kernel("f8(f8[:, ::1], f8[:, ::1])")
def largest_of(G: Array, P: Array) -> float:
    """Largest eigenvalue of ``G P``, both symmetric and P positive semidefinite.

    It equals that of ``L' G L`` with ``P = L L'`` (Cholesky).
    """
    L, B, V = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for j in range(3):
        for i in range(j, 3):
            value = P[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j:
                L[j, j] = np.sqrt(max(value, 0.0))
            else:
                L[i, j] = value / L[j, j] if L[j, j] > 0.0 else 0.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    B[i, j] += L[k, i] * 0.5 * (G[k, m] + G[m, k]) * L[m, j]
    eigen3(B, V)
    most: float = max(B[0, 0], max(B[1, 1], B[2, 2]))
    return most


@kernel("f8(f8[:, ::1])")
def det3(A: Array) -> float:
    """Determinant of a 3x3 matrix."""
    minor_0 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    minor_1 = A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0]
    minor_2 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    det: float = A[0, 0] * minor_0 - A[0, 1] * minor_1 + A[0, 2] * minor_2
    return det


@kernel("void(f8, f8, f8[:, ::1])")
def swing(x: float, y: float, P: Array) -> None:
    """Propagate a covariance (x, y, yaw) along a lever arm (x, y), in place: a heading error moves the far end.

    The lever arm is in the axes of ``P``. ``P`` may also be the cross-covariance of two such errors.
    """
    for j in range(3):
        P[0, j] -= y * P[2, j]
        P[1, j] += x * P[2, j]
    for i in range(3):
        P[i, 0] -= y * P[i, 2]
        P[i, 1] += x * P[i, 2]


@kernel("void(f8, f8[::1], f8[:, ::1])")
def add_turned(yaw: float, variance: Array, P: Array) -> None:
    """Add noise of ``variance`` (x, y, yaw) to a covariance, in place; its axes are turned by ``yaw``."""
    c, s = np.cos(yaw), np.sin(yaw)
    P[0, 0] += c * c * variance[0] + s * s * variance[1]
    P[1, 1] += s * s * variance[0] + c * c * variance[1]
    P[0, 1] += c * s * (variance[0] - variance[1])
    P[1, 0] += c * s * (variance[0] - variance[1])
    P[2, 2] += variance[2]


def symmetric(A: Array) -> Array:
    """Symmetric part of a matrix; removes the asymmetry that rounding leaves."""
    return np.asarray(0.5 * (A + A.T))
