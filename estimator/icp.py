"""Point-to-line ICP (Eq. 13) on the distance-region axis, with the prediction weighted in at every iteration (Eq. 14).

Eq. 14 adds transforms as matrices, which leaves the group of rigid motions; here the weight is the matrix
``W = (L1 + L2)^-1 L1`` of the two witnesses' information (L1 of the prediction T1, L2 of the laser T2), so that a
corridor takes its long axis from the prediction and a room takes everything from the laser.
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
        tolerance_m, tolerance_rad: a smaller update ends the iteration.
        min_points, min_share: fewest pairs, and fewest pairs per beam, that make a result.
    """

    gate_m: float = 0.5
    scale: float = 3.0
    temper: float = 10.0
    tolerance_m: float = 1e-4
    tolerance_rad: float = 2e-5
    min_points: int = 10
    min_share: float = 0.25


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


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8[:, ::1], f8[::1],"
    " Tuple((f8[:, ::1], f8[::1])))"
)
def iterate(
    xy: Array,
    reference: tuple[Array, Ints, Array, Array],
    T: Array,
    L1: Array,
    caps: Array,
    out: tuple[Array, Array],
) -> int:
    """Run the iterations; ``T`` (relative to the axis centre) is moved in place.

    ``caps``: iteration cap, gate, first and last robust scale, sigma, temper, two tolerances. ``out``: the laser's
    information (3, 3) and inliers, pairs, sum of squares, hash. Returns the iterations, negative when not converged.
    """
    rows, start, rays, normals = reference
    H, stats = out
    T1 = T.copy()
    A = np.empty((3, 3))
    b = np.empty(3)
    step = np.empty(3)
    scale = caps[2]
    count = 0
    settled = False
    while count < caps[0] and not settled:
        count += 1
        c, s = np.cos(T[2]), np.sin(T[2])
        gate2 = min(caps[1], max(6.0 * scale, 0.1)) ** 2
        h00 = h01 = h02 = h11 = h12 = h22 = g0 = g1 = g2 = 0.0
        inliers = pairs = 0
        squares = 0.0
        for i in range(len(xy)):
            ux = c * xy[i, 0] - s * xy[i, 1]
            uy = s * xy[i, 0] + c * xy[i, 1]
            px = ux + T[0]
            py = uy + T[1]
            row, _ = nearest(rows, start, rays, px, py, gate2)
            if row < 0:
                continue
            nx, ny = normals[row, 0], normals[row, 1]
            if nx == 0.0 and ny == 0.0:
                continue
            pairs += 1
            e = nx * (px - rows[row, 0]) + ny * (py - rows[row, 1])
            w = 1.0 / (1.0 + (e / scale) ** 2)
            if abs(e) < 2.0 * scale:
                inliers += 1
                squares += e * e
            jt = ny * ux - nx * uy
            h00 += w * nx * nx
            h01 += w * nx * ny
            h02 += w * nx * jt
            h11 += w * ny * ny
            h12 += w * ny * jt
            h22 += w * jt * jt
            g0 += w * nx * e
            g1 += w * ny * e
            g2 += w * jt * e
        k = 1.0 / (caps[4] * caps[4] * caps[5])
        H[0, 0], H[0, 1], H[0, 2] = k * h00, k * h01, k * h02
        H[1, 0], H[1, 1], H[1, 2] = k * h01, k * h11, k * h12
        H[2, 0], H[2, 1], H[2, 2] = k * h02, k * h12, k * h22
        stats[0], stats[1], stats[2] = inliers, pairs, squares
        for i in range(3):
            b[i] = 0.0
            for j in range(3):
                A[i, j] = H[i, j] + L1[i, j]
                b[i] -= L1[i, j] * (T[j] - T1[j])
        b[0] -= k * g0
        b[1] -= k * g1
        b[2] -= k * g2
        if solve3(A, b, step) == 0.0:
            break
        T[0] += step[0]
        T[1] += step[1]
        T[2] += step[2]
        small = abs(step[0]) + abs(step[1]) < caps[6] and abs(step[2]) < caps[7]
        settled = small and scale == caps[3]
        scale = max(caps[3], 0.5 * scale)
    return count if settled else -count


def match(
    xy: Array, local: LocalMap, T_pred: Array, L1: Array, caps: tuple[int, float], settings: MatchSettings
) -> MatchResult:
    """Match points (n, 2) in the base frame against the map, from the prediction ``T_pred`` with information ``L1``.

    ``caps``: iteration cap and one-sigma residual noise in metres.
    """
    axis, normals, sigma = local.axis, local.normals, caps[1]
    H = np.zeros((3, 3))
    stats = np.zeros(4)
    centre = np.array((axis.centre[0], axis.centre[1], 0.0))
    T = T_pred - centre
    spread = float(np.sqrt(1.0 / L1[0, 0] + 1.0 / L1[1, 1])) * 2.0
    last = settings.scale * sigma
    first = min(max(last, spread), settings.gate_m / 2.0)
    tolerances = (settings.tolerance_m, settings.tolerance_rad)
    c = np.array((caps[0], settings.gate_m, first, last, sigma, settings.temper, *tolerances))
    n = iterate(xy, (axis.rows, axis.start, axis.rays, normals), T, L1, c, (H, stats))
    inliers, pairs = int(stats[0]), int(stats[1])
    reason = Reason.CONVERGED if n > 0 else Reason.ITERATION_CAP
    if pairs < settings.min_points or inliers < settings.min_share * len(xy):
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
        len(xy),
        abs(n),
        float(np.sqrt(stats[2] / max(inliers, 1))),
        known_axes(H),
        correction,
        reason,
    )


def known_axes(H: Array) -> Array:
    """1 for each of x, y, yaw that the information fixes to 10 cm, 10 cm, 2 deg, else 0."""
    P = np.linalg.inv(H + np.diag((1e-2, 1e-2, 1e-2)))
    return np.asarray(np.diag(P) < np.array((0.01, 0.01, 0.0012)), dtype=np.float64)


def no_match(T_pred: Array, queries: int, reason: Reason) -> MatchResult:
    """A match that did not take place, and why."""
    return MatchResult(T_pred.copy(), np.zeros((3, 3)), 0, queries, 0, 0.0, np.zeros(3), np.zeros(3), reason)
