"""The paper's matcher (Sect. 4.2): closed-form point-to-point, the light's transform weighed in by probability.

    T1 -> virtual frame (Eq. 10-11) -> one merged axis (Eq. 12) -> pairs -> T2 (Eq. 13) -> w (Eq. 15) -> T_k (Eq. 14)

It is kept beside the default matcher (icp.py) for experiments. T1 is the relative pose of the `lights` filter: Eq. 13
on the only points that light knows, the lamps, seen from both bodies (``p_i = X_ref^-1 L_i``, ``q_i = X_new^-1 L_i``),
returns ``X_ref^-1 X_new`` whatever the lamps are. The reference is the newest keyframe's scan in its lidar's frame.

What is reported as information is not Censi's formula, which trusts pairs that slide along a wall with the pose and so
makes even a bare corridor look known (Bonnabel, Barczyk, Goulette, arXiv 1410.7632). A fixed point of the iteration
answers to noise as ``A^-1 sum g``: ``A`` holds only what remains when pairs are sought anew, the part along the
surface's normals; the gradients' own covariance ``B`` is taken from the residuals, summed over blocks of neighbouring
beams, whose pairs err together. The information is ``A B^-1 A``.
"""

from __future__ import annotations

import numpy as np

from estimator import beams, icp
from estimator.distance_region import Ints, nearest
from estimator.kernel import kernel
from estimator.linear3 import invert3
from estimator.records import Array
from estimator.weights import combine, information_weight, moved, paper_weight, turned, twist_between

REACH_M, FEW = 0.12, 2
"""A surface's direction comes from the neighbours within this, and from so many on either side at least."""

BLOCK = 16
"""Neighbouring beams whose pairs err together."""
PRIOR_BLOCKS = 8.0
"""So many blocks' worth of the expected covariance goes into the measured one."""

CAP, GATE, LAST, NOISE, SETTLED, MODE, MISFIT, MEASURED, EYE_X, EYE_Y, EYE_YAW = range(11)
"""Places in ``how``: iteration cap, gate, last robust scale, range noise, remaining way that ends it (m), 1 for the
paper's scalar weight; mean squared deviation of the light's links and their number (0: no light); the lidar's mount."""

Reference = tuple[Array, Ints, Array, Array]
"""Rows, start and rays of the axis; per row normal x, y, variance of the normal's direction, spacing of the points."""


@kernel("void(f8[:, ::1], f8, f8[:, ::1])")
def surfaces(xy: Array, sigma: float, out: Array) -> None:
    """Normal (x, y), variance of its direction (rad^2) and distance of the neighbours (m) for each point of a scan.

    Points (n, 2) stand in order of measurement. Where there is no line the normal is (0, 0).
    """
    n = len(xy)
    for i in range(n):
        low, high = i, i + 1
        while low > 0 and (xy[low - 1, 0] - xy[i, 0]) ** 2 + (xy[low - 1, 1] - xy[i, 1]) ** 2 < REACH_M * REACH_M:
            low -= 1
        while high < n and (xy[high, 0] - xy[i, 0]) ** 2 + (xy[high, 1] - xy[i, 1]) ** 2 < REACH_M * REACH_M:
            high += 1
        low, high = max(0, min(low, i - FEW)), min(n, max(high, i + FEW + 1))
        m = float(high - low)
        sx = sy = sxx = sxy = syy = 0.0
        for j in range(low, high):
            dx, dy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
            sx, sy, sxx, sxy, syy = sx + dx, sy + dy, sxx + dx * dx, sxy + dx * dy, syy + dy * dy
        cxx, cxy, cyy = sxx / m - (sx / m) ** 2, sxy / m - sx * sy / (m * m), syy / m - (sy / m) ** 2
        half, mean = 0.5 * (cxx - cyy), 0.5 * (cxx + cyy)
        root = np.sqrt(half * half + cxy * cxy)
        across, along = max(mean - root, 0.0), mean + root
        angle = 0.5 * np.arctan2(cxy, half)
        slope = max(sigma * sigma, across) / (m * along) if along > 0.0 else 1.0
        flat = slope < 0.03 and across < 0.1 * along
        out[i, 0], out[i, 1] = (-np.sin(angle), np.cos(angle)) if flat else (0.0, 0.0)
        out[i, 2] = slope
        out[i, 3] = np.sqrt(12.0 * along) / max(m - 1.0, 1.0)


@kernel("void(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8, i8[::1])")
def pair_up(points: Array, reference: Reference, T: Array, gate2: float, partner: Ints) -> None:
    """Step 1 of Sect. 4.2: each point of the virtual frame (Eq. 11) and the nearest of the reference, -1 where none."""
    rows, start, rays, _ = reference
    c, s = np.cos(T[2]), np.sin(T[2])
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        row, _, _ = nearest(rows, start, rays, c * x - s * y + T[0], s * x + c * y + T[1], gate2)
        partner[i] = row


@kernel("b1(f8[::1], f8[::1])")
def closed_form(m: Array, T: Array) -> bool:
    """Eq. 13 solved: the motion that brings the points q nearest to their partners p, in the least squares sense.

    ``m``: sum of weights, of ``w q`` (2), of ``w p`` (2), of ``w q_a p_b`` (xx, xy, yx, yy). False without a pair.
    """
    w = m[0]
    if not w > 0.0:
        return False
    qx, qy, px, py = m[1] / w, m[2] / w, m[3] / w, m[4] / w
    sxx, sxy, syx, syy = m[5] - w * qx * px, m[6] - w * qx * py, m[7] - w * qy * px, m[8] - w * qy * py
    T[2] = np.arctan2(sxy - syx, sxx + syy)
    c, s = np.cos(T[2]), np.sin(T[2])
    T[0] = px - c * qx + s * qy
    T[1] = py - s * qx - c * qy
    return True


@kernel("void(f8[::1], f8, UniTuple(f8, 2), UniTuple(f8, 2))")
def add_pair(m: Array, w: float, q: tuple[float, float], p: tuple[float, float]) -> None:
    """One pair more in the moments of :func:`closed_form`."""
    m[0] += w
    m[1] += w * q[0]
    m[2] += w * q[1]
    m[3] += w * p[0]
    m[4] += w * p[1]
    m[5] += w * q[0] * p[0]
    m[6] += w * q[0] * p[1]
    m[7] += w * q[1] * p[0]
    m[8] += w * q[1] * p[1]


@kernel("void(f8[:, ::1], f8[:, ::1], f8[::1])")
def align(q: Array, p: Array, T: Array) -> None:
    """Eq. 13 for given pairs of points (n, 2): T that maps q onto p."""
    m = np.zeros(9)
    for i in range(len(q)):
        add_pair(m, 1.0, (q[i, 0], q[i, 1]), (p[i, 0], p[i, 1]))
    closed_form(m, T)


@kernel(
    "void(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), i8[::1], f8[::1], f8,"
    " Tuple((f8[::1], f8[::1])))"
)
def sum_up(
    points: Array, reference: Reference, partner: Ints, T: Array, scale: float, out: tuple[Array, Array]
) -> None:
    """Step 2 of Sect. 4.2: moments of the weighted pairs for Eq. 13, and what the verdict wants to know of them.

    The weight is Cauchy's, with the spacing of the reference's points allowed for. ``out``: moments (9), and sums in
    the layout of `icp` (inliers, pairs, weights, squares along the normal, of one scan's noise).
    """
    m, sums = out
    rows, lines = reference[0], reference[3]
    c, s = np.cos(T[2]), np.sin(T[2])
    m[:] = 0.0
    inliers = pairs = weights = squares = 0.0
    for i in range(len(points)):
        row = partner[i]
        if row < 0:
            continue
        x, y = points[i, 0], points[i, 1]
        ex, ey = c * x - s * y + T[0] - rows[row, 0], s * x + c * y + T[1] - rows[row, 1]
        w = 1.0 / (1.0 + (ex * ex + ey * ey) / (scale * scale + lines[row, 3] ** 2))
        add_pair(m, w, (x, y), (rows[row, 0], rows[row, 1]))
        pairs += 1.0
        inliers += 1.0 if w > 0.2 else 0.0
        if lines[row, 0] != 0.0 or lines[row, 1] != 0.0:
            e = lines[row, 0] * ex + lines[row, 1] * ey
            weights += w
            squares += 0.5 * w * e * e
    sums[icp.INLIERS], sums[icp.PAIRS], sums[icp.WEIGHTS], sums[icp.SQUARES] = inliers, pairs, weights, squares


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def sandwich(A: Array, P: Array, H: Array) -> None:
    """``A P A`` of symmetric 3x3 matrices."""
    M = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            M[i, j] = A[i, 0] * P[0, j] + A[i, 1] * P[1, j] + A[i, 2] * P[2, j]
    for i in range(3):
        for j in range(3):
            H[i, j] = M[i, 0] * A[0, j] + M[i, 1] * A[1, j] + M[i, 2] * A[2, j]


@kernel("void(f8[:, ::1], f8, UniTuple(f8, 2), UniTuple(f8, 2))")
def add_outer(A: Array, w: float, n: tuple[float, float], u: tuple[float, float]) -> None:
    """Add ``w J J'``, where ``J = (n, n x u)`` is how a point at lever ``u`` moves along ``n`` with the pose."""
    turn = n[1] * u[0] - n[0] * u[1]
    A[0, 0] += w * n[0] * n[0]
    A[0, 1] += w * n[0] * n[1]
    A[0, 2] += w * n[0] * turn
    A[1, 1] += w * n[1] * n[1]
    A[1, 2] += w * n[1] * turn
    A[2, 2] += w * turn * turn


@kernel(
    "void(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), i8[::1], f8[::1],"
    " UniTuple(f8, 2), f8[:, ::1])"
)
def information(
    points: Array, reference: Reference, partner: Ints, T: Array, noise: tuple[float, float], H: Array
) -> None:
    """``A B^-1 A`` of the module's text, pose-centred in the reference's axes; ``noise``: robust scale, range noise."""
    rows, lines = reference[0], reference[3]
    c, s = np.cos(T[2]), np.sin(T[2])
    A, N, expected, B = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    g, keep, sums = np.zeros(3), np.empty((3, 3)), np.zeros(icp.SUMS)
    blocks, used = 0.0, 0
    for i in range(len(points)):
        if i % BLOCK == 0 or i == len(points) - 1:
            if used > 0:
                for a in range(3):
                    for b in range(a, 3):
                        B[a, b] += g[a] * g[b]
                blocks += 1.0
            g[:] = 0.0
            used = 0
        row = partner[i]
        if row < 0:
            continue
        x, y = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        ex, ey = x + T[0] - rows[row, 0], y + T[1] - rows[row, 1]
        nx, ny, slope, spacing = lines[row, 0], lines[row, 1], lines[row, 2], lines[row, 3]
        w = 1.0 / (1.0 + (ex * ex + ey * ey) / (noise[0] * noise[0] + spacing * spacing))
        add_outer(A, w, (nx, ny), (x, y))
        add_outer(N, w * slope, (-ny, nx), (x, y))
        add_outer(expected, 2.0 * (w * noise[1]) ** 2, (nx, ny), (x, y))
        add_outer(expected, (w * spacing) ** 2 / 12.0, (-ny, nx), (x, y))
        g[0], g[1], g[2] = g[0] + w * ex, g[1] + w * ey, g[2] + w * (x * ey - y * ex)
        used += 1
    at = 0
    share = 1.0 / (blocks + PRIOR_BLOCKS)
    for a in range(3):
        for b in range(a, 3):
            sums[at], sums[6 + at] = A[a, b], N[a, b]
            B[a, b] = B[b, a] = share * (blocks * B[a, b] + PRIOR_BLOCKS * expected[a, b])
            at += 1
    icp.trusted(sums, 1.0, A, keep)
    sandwich(A, invert3(B), H)


@kernel(
    "f8(f8[::1], Tuple((f8[::1], f8[:, ::1])), Tuple((f8[:, ::1], f8[::1], f8[::1], u1[::1], f8[::1])), f8[::1],"
    " f8[::1], f8[:, ::1])"
)
def weigh(T: Array, first: tuple[Array, Array], seen: beams.Seen, how: Array, expected: Array, W: Array) -> float:
    """Eq. 15 of the paper at the pose ``T``: Eq. 6 of light against Eq. 8-9 of the laser; returns the weight.

    Light's deviations are those of its links, and how far the pose is from where they put it.
    """
    W[:] = 0.0
    if how[MEASURED] <= 0.0:
        return 0.0  # the pause: no clear link, laser alone
    T1, L1 = first
    d, eye = np.empty(3), np.empty(3)
    twist_between(T1, T, d)
    log1 = -0.5 * (how[MISFIT] + icp.between(d, L1, d) / how[MEASURED])
    c, s = np.cos(T[2]), np.sin(T[2])
    eye[0] = T[0] + c * how[EYE_X] - s * how[EYE_Y]
    eye[1] = T[1] + s * how[EYE_X] + c * how[EYE_Y]
    eye[2] = T[2] + how[EYE_YAW]
    segments, bearing, distance, kind, model = seen
    beams.cast(segments, eye, bearing, expected)
    total, count = beams.sum_log((bearing, distance, kind), expected, model, 1)
    peak = np.log(model[beams.HIT] / (beams.ROOT_2PI * model[beams.SIGMA]))
    log2 = total / count - peak if count > 0 else -700.0
    paper_weight(log1, log2, W)
    return float(W[0, 0])


@kernel("void(f8[::1], f8[::1], UniTuple(f8, 3), f8[::1])")
def note(row: Array, T: Array, how: tuple[float, float, float], sums: Array) -> None:
    """A row of the trace: where the iteration began, with which scale and gate, how many points it looked up."""
    row[icp.AT_X], row[icp.AT_Y], row[icp.AT_YAW] = T[0], T[1], T[2]
    row[icp.SCALE], row[icp.GATE], row[icp.STRIDE], row[icp.SOUGHT] = how[0], how[1], 1.0, how[2]
    row[icp.FITTED : icp.SQUARED + 1] = sums[icp.INLIERS : icp.SQUARES + 1]
    row[icp.STEP2] = row[icp.DAMPED] = 0.0


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), Tuple((f8[::1], f8[:, ::1])),"
    " Tuple((f8[:, ::1], f8[::1], f8[::1], u1[::1], f8[::1])), f8[::1],"
    " Tuple((f8[::1], f8[:, ::1], f8[::1], f8[:, ::1])))"
)
def iterate(
    points: Array,
    reference: Reference,
    first: tuple[Array, Array],
    seen: beams.Seen,
    how: Array,
    out: tuple[Array, Array, Array, Array],
) -> int:
    """Sect. 4.2 until it stands still; the number of iterations.

    ``first``: T1 and its information in T1's own axes, the start. ``seen``: what Eq. 9 needs. ``how``: see above.
    ``out``: the pose, the laser's information, sums and trace in the layout of `icp`.
    A closed form step leaves a share of the way to go, the same each time: what remains is ``step / (1 - share)``. A
    step that turns back on the one before is halved. The robust scale shrinks no faster than the steps do.
    """
    T, H, sums, trace = out
    T1, L1 = first
    T[:] = T1
    T2, after, step, before = T.copy(), np.empty(3), np.empty(3), np.zeros(3)
    m, W, L = np.empty(9), np.zeros((3, 3)), np.empty((3, 3))
    partner, expected = np.full(len(points), -1), np.empty(len(seen[1]))
    lever = max(0.1, icp.mean_lever(points, how[EYE_X : EYE_Y + 1]))
    spread = np.sqrt(1.0 / L1[0, 0] + 1.0 / L1[1, 1] + lever * lever / L1[2, 2])
    scale, damping, way, count = min(max(how[LAST], 2.0 * spread), 0.5 * how[GATE]), 1.0, np.inf, 0
    sums[icp.SETTLED] = 0.0
    while count < how[CAP] and sums[icp.SETTLED] == 0.0:
        gate = min(how[GATE], max(6.0 * scale, 0.1))
        pair_up(points, reference, T, gate * gate, partner)
        sum_up(points, reference, partner, T, scale, (m, sums))
        note(trace[count], T, (scale, gate, float(len(points))), sums)
        count += 1
        if not closed_form(m, T2):
            break
        if how[MODE] == 1.0:
            weigh(T, first, seen, how, expected, W)
        combine(T1, T2, W, after)
        twist_between(T, after, step)
        back = step[0] * before[0] + step[1] * before[1] + lever * lever * step[2] * before[2]
        length = np.sqrt(step[0] ** 2 + step[1] ** 2 + (lever * step[2]) ** 2)
        if scale == how[LAST] and back < -0.25 * length * length:
            damping = max(0.125, 0.5 * damping)
        for i in range(3):
            before[i] = step[i]
            step[i] *= damping
        moved(T, step, T)
        share = min(0.95, length / way) if way > 0.0 else 0.0
        way = length
        remains = damping * length * share / (1.0 - share)
        sums[icp.DAMPING], sums[icp.LENGTH2] = damping, (remains / max(how[SETTLED], 1e-12)) ** 2
        trace[count - 1, icp.STEP2], trace[count - 1, icp.DAMPED] = sums[icp.LENGTH2], damping
        done = remains < how[SETTLED] and length < 5.0 * how[SETTLED] and scale == how[LAST]
        sums[icp.SETTLED] = 1.0 if done else 0.0
        scale = max(how[LAST], min(scale, max(0.5 * scale, 2.0 * length)))
    information(points, reference, partner, T, (scale, how[NOISE]), H)
    if how[MODE] == 0.0:
        turned(H, T[2], L)
        information_weight(L1, L, W)
        combine(T1, T, W, after)
        T[:] = after
    return count
