"""Point-to-line ICP (Eq. 13) on the distance-region axis, with the prediction weighted in at every iteration (Eq. 14).

Eq. 14 adds transforms as matrices, which leaves the group of rigid motions; here the weight is the matrix
``W = (L1 + L2)^-1 L1`` of the two witnesses' information (L1 of the prediction T1, L2 of the laser T2), so that a
corridor takes its long axis from the prediction and a room takes everything from the laser.

The laser's information is not allowed to flatter itself. Normals are fitted to noisy points, so a smooth wall seems to
hold a little along itself as well; the expected part of that is known (each normal carries the variance of its
direction) and is subtracted, and a direction in which nothing certain remains is left to the prediction.
"""

from __future__ import annotations

import numpy as np

from estimator.distance_region import Ints, nearest
from estimator.kernel import kernel
from estimator.linear3 import eigen3, positive, solve3
from estimator.records import Array

GRAZE = 0.2
"""Part of the range noise that remains across a surface met at a grazing angle: footprint, roughness, bearing."""

ASKEW = 0.6
"""Sine of the largest angle between a point's surface and its partner's, 37 deg: leaves room for a wrong heading."""

SHRINK = 2.0
"""Robust scale in units of what the last step moved a point."""

INLIERS, PAIRS, WEIGHTS, SQUARES, SETTLED, LENGTH2, DAMPING = range(15, 22)
"""Places in the sums behind the normal equations; ``SUMS`` in all."""

SUMS = 22

AT_X, AT_Y, AT_YAW, SCALE, GATE, STRIDE, FITTED, PAIRED, WEIGHED, SQUARED, STEP2, DAMPED, SOUGHT = range(13)
"""Columns of the trace, one row an iteration: the pose it began at (relative to the axis centre), robust scale, gate,
every how many points it took; inliers, pairs, weights and squares as in its sums; squared length of its step in its own
deviations and damping (0 if it made none); how many points were looked up because they had left their safe radius."""

TRACE = 13

Reference = tuple[Array, Ints, Array, Array]
"""Rows, start and rays of the axis, and per row normal x, y, variance of the normal's direction, weight."""

Memory = tuple[Ints, Ints, Array]
"""Per query: its partner (a row, or -1); the row found when last sought; where the query was then (x, y) and how far,
squared, it may move until another row can be nearest."""


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8, i8,"
    " Tuple((i8[::1], i8[::1], f8[:, ::1])))"
)
def pair_up(points: Array, reference: Reference, T: Array, gate2: float, stride: int, memory: Memory) -> int:
    """Step 1 of Sect. 4.2: the nearest row within the gate for every ``stride``-th point at pose ``T``.

    A point that has not left its safe radius keeps its row without being looked up; returns how many were.
    """
    sought = 0
    rows, start, rays, _ = reference
    partner, found, safe = memory
    c, s = np.cos(T[2]), np.sin(T[2])
    for i in range(0, len(points), stride):
        px = c * points[i, 0] - s * points[i, 1] + T[0]
        py = s * points[i, 0] + c * points[i, 1] + T[1]
        row = found[i]
        if row >= 0 and (px - safe[i, 0]) ** 2 + (py - safe[i, 1]) ** 2 < safe[i, 2]:
            d2 = (px - rows[row, 0]) ** 2 + (py - rows[row, 1]) ** 2
            partner[i] = row if d2 < gate2 else -1
            continue
        row, d2, e2 = nearest(rows, start, rays, px, py, gate2)
        partner[i] = found[i] = row
        safe[i, 0], safe[i, 1] = px, py
        safe[i, 2] = 0.25 * (np.sqrt(e2) - np.sqrt(d2)) ** 2
        sought += 1
    return sought


@kernel("void(f8[:, ::1], Tuple((f8[:, ::1], f8[:, ::1], i8[::1])), f8[::1], Tuple((f8, f8, f8)), i8, f8[::1])")
def sum_up(
    points: Array,
    pairs: tuple[Array, Array, Ints],
    T: Array,
    how: tuple[float, float, float],
    stride: int,
    sums: Array,
) -> None:
    """Step 2 of Sect. 4.2: the normal equations of point-to-line over the pairs.

    ``points``: x, y and tangent (n, 4). ``pairs``: rows, lines and each point's partner. ``how``: lidar in the base
    frame (x, y), robust scale. ``sums``: 6 of the information, 6 of its expected noise part, 3 of the gradient,
    inliers, pairs, robust weights and squares (m^2, scaled to what they would be as range noise).
    """
    rows, lines, partner = pairs
    c, s = np.cos(T[2]), np.sin(T[2])
    ex, ey = c * how[0] - s * how[1] + T[0], s * how[0] + c * how[1] + T[1]
    k = 1.0 / (how[2] * how[2])
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    n00 = n01 = n02 = n11 = n12 = n22 = 0.0
    g0 = g1 = g2 = inliers = count = weights = squares = 0.0
    for i in range(0, len(points), stride):
        row = partner[i]
        if row < 0:
            continue
        ux, uy = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        px, py = ux + T[0], uy + T[1]
        nx, ny, tx, ty = lines[row, 0], lines[row, 1], points[i, 2], points[i, 3]
        facing = nx * (ex - px) + ny * (ey - py)
        if facing <= 0.0:
            continue  # seen from behind: the other side of a thin wall
        if abs(nx * (c * tx - s * ty) + ny * (s * tx + c * ty)) > ASKEW:
            continue  # the other wall of a corner
        cos2 = facing * facing / ((ex - px) ** 2 + (ey - py) ** 2)
        p = 1.0 / (GRAZE + (1.0 - GRAZE) * cos2)  # precision in units of the range noise
        e = nx * (px - rows[row, 0]) + ny * (py - rows[row, 1])
        w = 1.0 / (1.0 + p * k * e * e)
        count += 1.0
        inliers += 1.0 if w > 0.2 else 0.0
        weights += w
        p *= lines[row, 3]
        squares += w * p * e * e
        w *= p
        turn, along = ny * ux - nx * uy, nx * ux + ny * uy
        h00, h01, h02 = h00 + w * nx * nx, h01 + w * nx * ny, h02 + w * nx * turn
        h11, h12, h22 = h11 + w * ny * ny, h12 + w * ny * turn, h22 + w * turn * turn
        v = w * lines[row, 2]
        n00, n01, n02 = n00 + v * ny * ny, n01 - v * nx * ny, n02 - v * ny * along
        n11, n12, n22 = n11 + v * nx * nx, n12 + v * nx * along, n22 + v * along * along
        g0, g1, g2 = g0 + w * nx * e, g1 + w * ny * e, g2 + w * turn * e
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = h00, h01, h02, h11, h12, h22
    sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = n00, n01, n02, n11, n12, n22
    sums[12], sums[13], sums[14] = g0, g1, g2
    sums[15], sums[16], sums[17], sums[18] = inliers, count, weights, squares


@kernel("void(f8[::1], f8, f8[:, ::1], f8[:, ::1])")
def trusted(sums: Array, k: float, H: Array, keep: Array) -> None:
    """The part of the information that is not the normals' noise, times ``k``, and the projector onto what it holds.

    A direction is held when its information is more than twice the part that noise alone explains; the test needs no
    scaling of metres against radians. Only where it fails are directions separated, with yaw in units of the points'
    mean lever.
    """
    M = np.empty((3, 3))
    at = 0
    for i in range(3):
        for j in range(i, 3):
            H[i, j] = H[j, i] = k * (sums[at] - sums[6 + at])
            M[i, j] = M[j, i] = k * (sums[at] - 2.0 * sums[6 + at])
            keep[i, j] = keep[j, i] = 1.0 if i == j else 0.0
            at += 1
    if positive(M):
        return
    lever = np.sqrt(max(sums[5] + sums[11], 1e-9) / max(sums[0] + sums[3], 1e-9))
    scale = np.array((1.0, 1.0, 1.0 / lever))
    V = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            M[i, j] *= scale[i] * scale[j]
            keep[i, j] = 0.0
    eigen3(M, V)
    for d in range(3):
        if M[d, d] > 0.0:
            for i in range(3):
                for j in range(3):
                    keep[i, j] += V[i, d] * V[j, d] * scale[j] / scale[i]
    for i in range(3):
        for j in range(3):
            M[i, j] = H[i, 0] * keep[j, 0] + H[i, 1] * keep[j, 1] + H[i, 2] * keep[j, 2]
    for i in range(3):
        for j in range(3):
            H[i, j] = keep[i, 0] * M[0, j] + keep[i, 1] * M[1, j] + keep[i, 2] * M[2, j]


@kernel("f8(f8[:, ::1], f8[::1])")
def mean_lever(points: Array, eye: Array) -> float:
    """Root mean square distance of the points from the lidar: metres that they move per radian."""
    square = 0.0
    for i in range(len(points)):
        square += (points[i, 0] - eye[0]) ** 2 + (points[i, 1] - eye[1]) ** 2
    return float(np.sqrt(square / max(len(points), 1)))


@kernel("f8(f8[::1], f8[:, ::1], f8[::1])")
def between(u: Array, A: Array, v: Array) -> float:
    """``u' A v`` of two steps (3,), as the information A (3, 3) weighs them."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += u[i] * A[i, j] * v[j]
    return total


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8[:, ::1], f8[::1],"
    " Tuple((f8[:, ::1], f8[::1], f8[:, ::1])))"
)
def iterate(
    points: Array, reference: Reference, T: Array, L1: Array, how: Array, out: tuple[Array, Array, Array]
) -> int:
    """Iterate Eq. 13-14 from ``T`` (relative to the axis centre), which is moved in place; the number of iterations.

    The robust scale shrinks from twice what the prediction's uncertainty moves a point to a few times the noise, not
    faster than the steps do; until then every fourth point will do. A step that turns back on the one before is halved:
    pairs may alternate between two sets.
    ``how``: lidar in the base frame (x, y), iteration cap, gate, last scale, noise, least step in its own deviations,
    stride while coarse. ``out``: the laser's information (3, 3); the sums of the last pass with SETTLED, LENGTH2
    (squared length of the last step in its own deviations) and DAMPING; the trace (cap, TRACE), a row an iteration.
    """
    H, sums, trace = out
    T1 = T.copy()
    A = np.empty((3, 3))
    b = np.empty(3)
    step = np.empty(3)
    before = np.zeros(3)
    keep = np.empty((3, 3))
    last, lever = how[4], mean_lever(points, how[:2])
    spread = np.sqrt(1.0 / L1[0, 0] + 1.0 / L1[1, 1] + lever * lever / L1[2, 2])
    scale = min(max(last, 2.0 * spread), 0.5 * how[3])
    memory = (np.full(len(points), -1), np.full(len(points), -1), np.zeros((len(points), 3)))
    damping = 1.0
    count = 0
    sums[SETTLED] = 0.0
    while count < how[2] and sums[SETTLED] == 0.0:
        row = trace[count]
        count += 1
        stride = int(how[7]) if scale > 2.0 * last else 1
        k = stride / (how[5] * how[5])
        gate = min(how[3], max(6.0 * scale, 0.1))
        row[AT_X], row[AT_Y], row[AT_YAW], row[SCALE], row[GATE], row[STRIDE] = T[0], T[1], T[2], scale, gate, stride
        row[SOUGHT] = pair_up(points, reference, T, gate * gate, stride, memory)
        sum_up(points, (reference[0], reference[3], memory[0]), T, (how[0], how[1], scale), stride, sums)
        sums[INLIERS] *= stride
        sums[PAIRS] *= stride
        row[FITTED : SQUARED + 1] = sums[INLIERS : SQUARES + 1]
        row[STEP2] = row[DAMPED] = 0.0
        trusted(sums, k, H, keep)
        for i in range(3):
            b[i] = 0.0
            for j in range(3):
                A[i, j] = H[i, j] + L1[i, j]
                b[i] -= k * keep[i, j] * sums[12 + j] + L1[i, j] * (T[j] - T1[j])
        if solve3(A, b, step) == 0.0:
            break
        length2, turned = between(step, A, step), between(step, A, before)
        if scale == last and turned < -0.25 * length2:
            damping = max(0.125, 0.5 * damping)
        for i in range(3):
            T[i] += damping * step[i]
            before[i] = step[i]
        sums[LENGTH2], sums[DAMPING] = length2, damping
        row[STEP2], row[DAMPED] = length2, damping
        sums[SETTLED] = 1.0 if length2 < how[6] * how[6] and scale == last else 0.0
        moved = np.sqrt(step[0] * step[0] + step[1] * step[1]) + lever * abs(step[2])
        scale = max(last, min(scale, max(0.25 * scale, SHRINK * moved)))
    return count
