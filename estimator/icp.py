"""Point-to-line ICP (Eq. 13) on the distance-region axis, with the prediction weighted in at every iteration (Eq. 14).

Eq. 14 adds transforms as matrices, which leaves the group of rigid motions; here the weight is the matrix
``W = (L1 + L2)^-1 L1`` of the two witnesses' information (L1 of the prediction T1, L2 of the laser T2), so that a
corridor takes its long axis from the prediction and a room takes everything from the laser.

The laser's information is not allowed to flatter itself. Normals are fitted to noisy points, so a smooth wall seems to
hold a little along itself as well; the expected part of that is known (each normal carries the variance of its
direction) and is subtracted, and a direction in which nothing certain remains is left to the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator import se2
from estimator.distance_region import Ints, nearest
from estimator.kernel import kernel
from estimator.localmap import LocalMap
from estimator.records import Array
from estimator.result import MatchResult, Reason


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """Matching, in terms of the physics.

    Attributes:
        gate_m: farthest partner ever accepted. scale: final robust scale in units of the residual's own noise.
        temper: how many beams share one error (mixed map and sensor errors are not independent from beam to beam).
        settled: an update shorter than this share of its own standard deviation ends the iteration.
        min_points, min_share: fewest pairs, and fewest pairs per beam, that make a result.
    """

    gate_m: float = 0.5
    scale: float = 2.5
    temper: float = 1.0
    settled: float = 0.1
    min_points: int = 10
    min_share: float = 0.25
    coarse: int = 4


@kernel("f8(f8[:, ::1], f8[::1], f8[::1])")
def solve3(A: Array, b: Array, x: Array) -> float:
    """Solve a symmetric positive 3x3 system by Cramer's rule; returns the determinant (x is 0 where it vanishes)."""
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


@kernel("void(f8[:, ::1], f8[:, ::1])")
def eigen3(A: Array, V: Array) -> None:
    """Diagonalise a symmetric 3x3 matrix in place by Jacobi rotations; the columns of ``V`` are its eigenvectors."""
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


@kernel(
    "void(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8[::1], Tuple((f8, f8, i8)),"
    " f8[::1])"
)
def pair_up(
    xy: Array,
    reference: tuple[Array, Ints, Array, Array],
    T: Array,
    eye: Array,
    how: tuple[float, float, int],
    sums: Array,
) -> None:
    """One pass: nearest neighbours at pose ``T`` and the sums of the normal equations over the pairs.

    ``reference``: the axis' rows, start and rays, and per row normal x, y and the variance of the normal's direction.
    ``eye``: the lidar in the base frame. ``how``: robust scale, squared gate, stride through the points.
    ``sums``: 6 of the information, 6 of its expected noise part, 3 of the gradient, inliers, pairs, weights, squares.
    """
    rows, start, rays, lines = reference
    scale, gate2, stride = how
    c, s = np.cos(T[2]), np.sin(T[2])
    ex, ey = c * eye[0] - s * eye[1] + T[0], s * eye[0] + c * eye[1] + T[1]
    k = 1.0 / (scale * scale)
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    n00 = n01 = n02 = n11 = n12 = n22 = 0.0
    g0 = g1 = g2 = inliers = pairs = weights = squares = 0.0
    for i in range(0, len(xy), stride):
        ux = c * xy[i, 0] - s * xy[i, 1]
        uy = s * xy[i, 0] + c * xy[i, 1]
        px = ux + T[0]
        py = uy + T[1]
        row, _ = nearest(rows, start, rays, px, py, gate2)
        if row < 0:
            continue
        nx, ny = lines[row, 0], lines[row, 1]
        if nx * (ex - px) + ny * (ey - py) <= 0.0:
            continue  # seen from behind: the other side of a thin wall
        pairs += 1.0
        e = nx * (px - rows[row, 0]) + ny * (py - rows[row, 1])
        w = 1.0 / (1.0 + k * e * e)
        if w > 0.2:
            inliers += 1.0
        weights += w
        squares += w * e * e
        turn = ny * ux - nx * uy
        along = nx * ux + ny * uy
        h00 += w * nx * nx
        h01 += w * nx * ny
        h02 += w * nx * turn
        h11 += w * ny * ny
        h12 += w * ny * turn
        h22 += w * turn * turn
        v = w * lines[row, 2]
        n00 += v * ny * ny
        n01 -= v * nx * ny
        n02 -= v * ny * along
        n11 += v * nx * nx
        n12 += v * nx * along
        n22 += v * along * along
        g0 += w * nx * e
        g1 += w * ny * e
        g2 += w * turn * e
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = h00, h01, h02, h11, h12, h22
    sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = n00, n01, n02, n11, n12, n22
    sums[12], sums[13], sums[14] = g0, g1, g2
    sums[15], sums[16], sums[17], sums[18] = inliers, pairs, weights, squares


@kernel("f8(f8[::1], f8, f8[:, ::1], f8[:, ::1])")
def trusted(sums: Array, k: float, H: Array, keep: Array) -> float:
    """The part of the information that is not the normals' noise, times ``k``, and the projector onto what it holds.

    Returns the number of directions held. A direction counts when its information is more than twice the part that
    noise alone explains; the test needs no scaling of metres against radians. Only where it fails are directions
    separated, with yaw in units of the points' mean lever.
    """
    M = np.empty((3, 3))
    at = 0
    for i in range(3):
        for j in range(i, 3):
            H[i, j] = H[j, i] = k * (sums[at] - sums[6 + at])
            M[i, j] = M[j, i] = k * (sums[at] - 2.0 * sums[6 + at])
            keep[i, j] = keep[j, i] = 1.0 if i == j else 0.0
            at += 1
    minor = M[0, 0] * M[1, 1] - M[0, 1] * M[0, 1]
    det = (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[1, 2])
        - M[0, 1] * (M[0, 1] * M[2, 2] - M[1, 2] * M[0, 2])
        + M[0, 2] * (M[0, 1] * M[1, 2] - M[1, 1] * M[0, 2])
    )
    if M[0, 0] > 0.0 and minor > 0.0 and det > 0.0:
        return 3.0
    lever = np.sqrt(max(sums[5] + sums[11], 1e-9) / max(sums[17], 1e-9))
    S = np.array((1.0, 1.0, 1.0 / lever))
    V = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            M[i, j] *= S[i] * S[j]
    eigen3(M, V)
    held = 0.0
    P = np.zeros((3, 3))
    for d in range(3):
        if M[d, d] > 0.0:
            held += 1.0
            for i in range(3):
                for j in range(3):
                    P[i, j] += V[i, d] * V[j, d]
    for i in range(3):
        for j in range(3):
            keep[i, j] = P[i, j] * S[j] / S[i]
    H[:] = keep @ H @ keep.T
    return held


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8[:, ::1], f8[::1], f8[::1],"
    " Tuple((f8[:, ::1], f8[::1])))"
)
def iterate(
    xy: Array,
    reference: tuple[Array, Ints, Array, Array],
    T: Array,
    L1: Array,
    eye: Array,
    caps: Array,
    out: tuple[Array, Array],
) -> int:
    """Run the iterations; ``T`` (relative to the axis centre) is moved in place.

    ``caps``: iteration cap, gate, first and last robust scale, sigma, temper, settled, coarse stride. ``out``: the
    laser's information (3, 3) and the sums of the last pass. Returns the iterations, negative when not converged.
    """
    H, sums = out
    T1 = T.copy()
    A = np.empty((3, 3))
    b = np.empty(3)
    g = np.empty(3)
    step = np.empty(3)
    keep = np.empty((3, 3))
    scale = caps[2]
    count = 0
    settled = False
    k = 1.0 / (caps[4] * caps[4] * caps[5])
    while count < caps[0] and not settled:
        count += 1
        coarse = scale > 2.0 * caps[3]
        stride = int(caps[7]) if coarse else 1
        pair_up(xy, reference, T, eye, (scale, min(caps[1], max(6.0 * scale, 0.1)) ** 2, stride), sums)
        trusted(sums, k * stride, H, keep)
        for i in range(3):
            g[i] = -k * stride * sums[12 + i]
        for i in range(3):
            b[i] = 0.0
            for j in range(3):
                A[i, j] = H[i, j] + L1[i, j]
                b[i] += keep[i, j] * g[j] - L1[i, j] * (T[j] - T1[j])
        if solve3(A, b, step) == 0.0:
            break
        length2 = 0.0
        for i in range(3):
            T[i] += step[i]
            for j in range(3):
                length2 += step[i] * A[i, j] * step[j]
        settled = length2 < caps[6] * caps[6] and scale == caps[3]
        scale = max(caps[3], 0.25 * scale) if length2 < 4.0 else max(caps[3], 0.5 * scale)
    return count if settled else -count


def match(
    points: Array,
    eye: Array,
    local: LocalMap,
    T_pred: Array,
    L1: Array,
    caps: tuple[int, float],
    settings: MatchSettings,
) -> MatchResult:
    """Match points (n, 2) in the base frame against the map, from the prediction ``T_pred`` with information ``L1``.

    ``caps``: iteration cap and one-sigma residual noise in metres.
    """
    axis, sigma = local.axis, caps[1]
    H = np.zeros((3, 3))
    sums = np.zeros(19)
    centre = np.array((axis.centre[0], axis.centre[1], 0.0))
    T = T_pred - centre
    spread = float(np.sqrt(1.0 / L1[0, 0] + 1.0 / L1[1, 1])) * 2.0
    last = settings.scale * sigma
    first = min(max(last, spread), settings.gate_m / 2.0)
    coarse = settings.coarse if len(points) > 400 else 1
    c = np.array((caps[0], settings.gate_m, first, last, sigma, settings.temper, settings.settled, coarse))
    n = iterate(points, (axis.rows, axis.start, axis.rays, local.lines), T, L1, np.ascontiguousarray(eye), c, (H, sums))
    inliers, pairs = int(sums[15]), int(sums[16])
    reason = Reason.CONVERGED if n > 0 else Reason.ITERATION_CAP
    if pairs < settings.min_points or inliers < settings.min_share * len(points):
        reason = Reason.TOO_FEW_PAIRS
    T = T + centre
    T[2] = se2.wrap(T[2])
    correction = T - T_pred
    correction[2] = se2.wrap(correction[2])
    ok = reason in (Reason.CONVERGED, Reason.ITERATION_CAP)
    return MatchResult(
        T if ok else T_pred.copy(),
        H,
        inliers,
        len(points),
        abs(n),
        float(np.sqrt(sums[18] / max(sums[17], 1.0))),
        known_axes(H),
        correction,
        reason,
    )


def known_axes(H: Array) -> Array:
    """1 for each of x, y, yaw that the information fixes to 10 cm, 10 cm, 2 deg, else 0."""
    P = np.linalg.inv(H + np.diag((4.0, 4.0, 30.0)))
    return np.asarray(np.diag(P) < np.array((0.01, 0.01, 0.0012)), dtype=np.float64)


def no_match(T_pred: Array, queries: int, reason: Reason) -> MatchResult:
    """A match that did not take place, and why."""
    return MatchResult(T_pred.copy(), np.zeros((3, 3)), 0, queries, 0, 0.0, np.zeros(3), np.zeros(3), reason)
