"""Pair sums of the paper's point-to-point matcher: surface normals, Eq. 13 in closed form, and its information.

The information is not Censi's formula. That one keeps the pairs fixed, although they slide along a wall. So it makes
even a bare corridor look known (Bonnabel, Barczyk, Goulette, arXiv 1410.7632). After a new search at another pose, only
a pair's part along the surface normal remains. ``A`` are the normal equations of that part, ``B`` is the covariance of
their gradient. Noise moves the solution by a covariance ``A^-1 B A^-1``. The rest is not noise. At convergence all
forces balance. Pairs pull along the walls, because two scans do not hit a wall at the same points. That pull holds
against the normals' gradient. A few more steps along the normals give the resulting error ``d``, and ``d d'`` is added.
These steps are slightly wrong themselves, so a part of its square is added in all directions.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.numerics.symmetric3 import invert3, solve3
from estimator.scan_matching import icp

REACH_M, FEW = 0.12, 2
"""Radius (m) of the neighbours that give a surface's direction, and fewest of them on either side."""

VAGUE = 4.0
"""Information of a pose known to 0.5 m (and rad); it regularises directions without information."""

ASIDE = 0.05
"""Share of the squared displacement that is added in all directions."""

SLOPE = 2
"""Third column of a surface, behind its normal: variance of its direction, rad^2.

The normal is (0, 0) without a surface.
"""

Pairs = tuple[Array, Array, Ints]
"""Rows of the axis, surface of each row, and the row of each new point's partner, -1 for none."""


@kernel("void(f8[:, ::1], f8, f8[:, ::1])")
def surfaces(xy: Array, sigma: float, out: Array) -> None:
    """Write the surface at each point of a scan: normal (x, y), direction variance (rad^2), neighbour distance (m).

    Points (n, 2) are in order of measurement. Where there is no line the normal is (0, 0).
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


@kernel("void(f8[::1], f8, UniTuple(f8, 2), UniTuple(f8, 2))", inner=True)
def add_pair(m: Array, w: float, q: tuple[float, float], p: tuple[float, float]) -> None:
    """Add one pair to the moments of :func:`closed_form`."""
    m[0] += w
    m[1] += w * q[0]
    m[2] += w * q[1]
    m[3] += w * p[0]
    m[4] += w * p[1]
    m[5] += w * q[0] * p[0]
    m[6] += w * q[0] * p[1]
    m[7] += w * q[1] * p[0]
    m[8] += w * q[1] * p[1]


@kernel("b1(f8[::1], f8[::1])")
def closed_form(m: Array, T: Array) -> bool:
    """Eq. 13 solved: the least-squares motion from the points q to their partners p, written to ``T``.

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


@kernel("void(f8[:, ::1], f8[:, ::1], f8[::1])")
def align(q: Array, p: Array, T: Array) -> None:
    """Eq. 13 for given pairs of points (n, 2): writes the T that maps q onto p."""
    m = np.zeros(9)
    for i in range(len(q)):
        add_pair(m, 1.0, (q[i, 0], q[i, 1]), (p[i, 0], p[i, 1]))
    closed_form(m, T)


@kernel("void(f8[:, ::1], f8, UniTuple(f8, 2), UniTuple(f8, 2))", inner=True)
def add_outer(A: Array, w: float, n: tuple[float, float], u: tuple[float, float]) -> None:
    """Add ``w J J'`` with ``J = (n, n x u)``: displacement along ``n`` of a point at lever ``u`` by the pose."""
    turn = n[1] * u[0] - n[0] * u[1]
    A[0, 0] += w * n[0] * n[0]
    A[0, 1] += w * n[0] * n[1]
    A[0, 2] += w * n[0] * turn
    A[1, 1] += w * n[1] * n[1]
    A[1, 2] += w * n[1] * turn
    A[2, 2] += w * turn * turn


@kernel("void(f8[:, ::1], Tuple((f8[:, ::1], f8[:, ::1], i8[::1])), f8[::1], f8, Tuple((f8[::1], f8[::1])))")
def sum_up(points: Array, pairs: Pairs, T: Array, scale: float, out: tuple[Array, Array]) -> None:
    """Step 2 of Sect. 4.2: moments of the weighted pairs for Eq. 13, and the sums for the acceptance test.

    The weight is Cauchy's, with an allowance for the spacing of the reference's points. ``out``: moments (9), and sums
    in the layout of `icp`. These are the normal equations along the normals, inliers, pairs and weights. The squares
    along the normal are scaled to the noise of one scan.
    """
    m, sums = out
    rows, lines, partner = pairs
    c, s = np.cos(T[2]), np.sin(T[2])
    m[:] = 0.0
    A = np.zeros((3, 3))
    inliers = count = weights = squares = 0.0
    for i in range(len(points)):
        row = partner[i]
        if row < 0:
            continue
        x, y = points[i, 0], points[i, 1]
        ex, ey = c * x - s * y + T[0] - rows[row, 0], s * x + c * y + T[1] - rows[row, 1]
        w = 1.0 / (1.0 + (ex * ex + ey * ey) / (scale * scale + lines[row, 3] ** 2))
        add_pair(m, w, (x, y), (rows[row, 0], rows[row, 1]))
        count += 1.0
        inliers += 1.0 if w > 0.2 else 0.0
        if lines[row, 0] != 0.0 or lines[row, 1] != 0.0:
            add_outer(A, w, (lines[row, 0], lines[row, 1]), (c * x - s * y, s * x + c * y))
            e = lines[row, 0] * ex + lines[row, 1] * ey
            weights += w
            squares += 0.5 * w * e * e
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
    sums[icp.INLIERS], sums[icp.PAIRS], sums[icp.WEIGHTS], sums[icp.SQUARES] = inliers, count, weights, squares


@kernel(
    "void(f8[:, ::1], Tuple((f8[:, ::1], f8[:, ::1], i8[::1])), f8[::1], UniTuple(f8, 2),"
    " Tuple((f8[:, ::1], f8[:, ::1], f8[::1])))"
)
def along_normals(
    points: Array, pairs: Pairs, T: Array, noise: tuple[float, float], out: tuple[Array, Array, Array]
) -> None:
    """Normal equations of the pairs' part along the surface normals, which a new search at another pose keeps.

    ``noise``: robust scale, range noise. ``out``: A (3, 3), the covariance B (3, 3) of its gradient, and the gradient
    (3); pose-centred, in the reference's axes. A direction with no more information than the normals' noise explains is
    removed from A and from the gradient (`icp.trusted`).
    """
    rows, lines, partner = pairs
    c, s = np.cos(T[2]), np.sin(T[2])
    A, B, g = out
    N, keep, sums = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(icp.SUMS)
    A[:], B[:], g[:] = 0.0, 0.0, 0.0
    total = np.zeros(3)
    for i in range(len(points)):
        row = partner[i]
        if row < 0 or (lines[row, 0] == 0.0 and lines[row, 1] == 0.0):
            continue
        x, y = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        ex, ey = x + T[0] - rows[row, 0], y + T[1] - rows[row, 1]
        nx, ny, slope, spacing = lines[row, 0], lines[row, 1], lines[row, 2], lines[row, 3]
        w = 1.0 / (1.0 + (ex * ex + ey * ey) / (noise[0] * noise[0] + spacing * spacing))
        e = nx * ex + ny * ey
        w *= 1.0 / (1.0 + e * e / (noise[0] * noise[0]))
        add_outer(A, w, (nx, ny), (x, y))
        add_outer(N, w * slope, (-ny, nx), (x, y))
        add_outer(B, w * w * max(2.0 * noise[1] * noise[1], e * e), (nx, ny), (x, y))
        total[0], total[1], total[2] = (
            total[0] + w * nx * e,
            total[1] + w * ny * e,
            total[2] + w * e * (x * ny - y * nx),
        )
    at = 0
    for a in range(3):
        for b in range(a, 3):
            sums[at], sums[6 + at] = A[a, b], N[a, b]
            B[b, a] = B[a, b]
            at += 1
    icp.trusted(sums, 1.0, A, keep)
    for a in range(3):
        g[a] = keep[a, 0] * total[0] + keep[a, 1] * total[1] + keep[a, 2] * total[2]


@kernel("void(f8[:, ::1], f8[::1], f8, f8[::1])")
def step_along(A: Array, g: Array, noise: float, d: Array) -> None:
    """Write the step of :func:`along_normals`, zero in directions without information."""
    M, b = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        b[i] = -g[i]
        for j in range(3):
            M[i, j] = A[i, j] + (VAGUE * noise * noise if i == j else 0.0)
    solve3(M, b, d)


@kernel("void(f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1])")
def information(A: Array, B: Array, d: Array, H: Array) -> None:
    """Write ``(A^-1 (B + q A) A^-1 + d d')^-1`` with ``q = ASIDE d' A d``, in a form that allows a singular A."""
    M, u = np.empty((3, 3)), np.empty(3)
    aside = ASIDE * icp.between(d, A, d)
    for i in range(3):
        for j in range(3):
            M[i, j] = B[i, j] + aside * A[i, j]
    P = invert3(M)
    for i in range(3):
        for j in range(3):
            M[i, j] = A[i, 0] * P[0, j] + A[i, 1] * P[1, j] + A[i, 2] * P[2, j]
    for i in range(3):
        for j in range(3):
            H[i, j] = M[i, 0] * A[0, j] + M[i, 1] * A[1, j] + M[i, 2] * A[2, j]
    q = 1.0
    for i in range(3):
        u[i] = H[i, 0] * d[0] + H[i, 1] * d[1] + H[i, 2] * d[2]
        q += u[i] * d[i]
    for i in range(3):
        for j in range(3):
            H[i, j] -= u[i] * u[j] / q
