"""Sparse L D L^T factorisation and solution of symmetric systems of 3 x 3 blocks (pose graph).

The sparsity pattern comes from `elimination_ordering`.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel

Pattern = tuple[Ints, Ints, Ints, Ints]
"""Sparsity pattern of the factor: column start and rows, row start and columns; see `elimination_ordering.columns`."""


@kernel("b1(f8[:, ::1], f8[:, ::1])", inner=True)
def invert_block(A: Array, out: Array) -> bool:
    """Invert a symmetric 3 x 3 block into ``out``; False if it is not positive definite."""
    a, b, c, d, e, f = A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * p + b * q + c * r
    if not (a > 0.0 and a * d - b * b > 0.0 and det > 0.0):
        return False
    s = 1.0 / det
    out[0, 0], out[0, 1], out[0, 2] = p * s, q * s, r * s
    out[1, 0], out[1, 1], out[1, 2] = q * s, (a * f - c * c) * s, (b * c - a * e) * s
    out[2, 0], out[2, 1], out[2, 2] = r * s, (b * c - a * e) * s, (a * d - b * b) * s
    return True


@kernel(
    "i8(Tuple((i8[::1], i8[::1], i8[::1], i8[::1])), Tuple((f8[:, :, ::1], f8[:, :, ::1])), f8[:, :, ::1])", inner=True
)
def factor(pattern: Pattern, matrix: tuple[Array, Array], inverse: Array) -> int:
    """Left-looking L D L^T in place. Returns the first column that is not positive definite, or -1.

    Args:
        pattern: sparsity pattern of the factor.
        matrix: diagonal blocks (n, 3, 3) and the blocks below it (nnz, 3, 3), at the positions of the pattern.
            Afterwards the blocks below the diagonal hold ``U = L D``.
        inverse: (n, 3, 3) out: the inverse of D.
    """
    start, down, row_start, across = pattern
    diagonal, below = matrix
    n = len(start) - 1
    work = np.zeros((n, 3, 3))
    at = start[:n].copy()
    P = np.empty((3, 3))
    for j in range(n):
        work[j] = diagonal[j]
        for m in range(start[j], start[j + 1]):
            work[down[m]] = below[m]
        for h in range(row_start[j], row_start[j + 1]):
            k = across[h]
            first = at[k]
            at[k] = first + 1
            for r in range(3):
                for c in range(3):
                    P[r, c] = 0.0
                    for s in range(3):
                        P[r, c] += inverse[k, r, s] * below[first, c, s]
            p00, p01, p02, p10, p11, p12 = P[0, 0], P[0, 1], P[0, 2], P[1, 0], P[1, 1], P[1, 2]
            p20, p21, p22 = P[2, 0], P[2, 1], P[2, 2]
            for m in range(first, start[k + 1]):
                i = down[m]
                a, b, c_ = below[m, 0, 0], below[m, 0, 1], below[m, 0, 2]
                d, e, f = below[m, 1, 0], below[m, 1, 1], below[m, 1, 2]
                g, u, v = below[m, 2, 0], below[m, 2, 1], below[m, 2, 2]
                work[i, 0, 0] -= a * p00 + b * p10 + c_ * p20
                work[i, 0, 1] -= a * p01 + b * p11 + c_ * p21
                work[i, 0, 2] -= a * p02 + b * p12 + c_ * p22
                work[i, 1, 0] -= d * p00 + e * p10 + f * p20
                work[i, 1, 1] -= d * p01 + e * p11 + f * p21
                work[i, 1, 2] -= d * p02 + e * p12 + f * p22
                work[i, 2, 0] -= g * p00 + u * p10 + v * p20
                work[i, 2, 1] -= g * p01 + u * p11 + v * p21
                work[i, 2, 2] -= g * p02 + u * p12 + v * p22
        if not invert_block(work[j], inverse[j]):
            return j
        for m in range(start[j], start[j + 1]):
            below[m] = work[down[m]]
    return -1


@kernel("void(Tuple((i8[::1], i8[::1], i8[::1], i8[::1])), f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1])", inner=True)
def solve(pattern: Pattern, below: Array, inverse: Array, b: Array) -> None:
    """Solve the factored system in place: ``b`` (n, 3), in elimination order, becomes the solution.

    Args:
        pattern: sparsity pattern of the factor.
        below: (nnz, 3, 3) ``U = L D`` of :func:`factor`.
        inverse: (n, 3, 3) the inverse of D.
        b: (n, 3) right-hand side, replaced by the solution.
    """
    start, down = pattern[0], pattern[1]
    n = len(start) - 1
    for j in range(n):
        x, y, z = b[j, 0], b[j, 1], b[j, 2]
        for r in range(3):
            b[j, r] = inverse[j, r, 0] * x + inverse[j, r, 1] * y + inverse[j, r, 2] * z
        x, y, z = b[j, 0], b[j, 1], b[j, 2]
        for m in range(start[j], start[j + 1]):
            i = down[m]
            for r in range(3):
                b[i, r] -= below[m, r, 0] * x + below[m, r, 1] * y + below[m, r, 2] * z
    for j in range(n - 1, -1, -1):
        x = y = z = 0.0
        for m in range(start[j], start[j + 1]):
            i = down[m]
            x += below[m, 0, 0] * b[i, 0] + below[m, 1, 0] * b[i, 1] + below[m, 2, 0] * b[i, 2]
            y += below[m, 0, 1] * b[i, 0] + below[m, 1, 1] * b[i, 1] + below[m, 2, 1] * b[i, 2]
            z += below[m, 0, 2] * b[i, 0] + below[m, 1, 2] * b[i, 1] + below[m, 2, 2] * b[i, 2]
        for r in range(3):
            b[j, r] -= inverse[j, r, 0] * x + inverse[j, r, 1] * y + inverse[j, r, 2] * z
