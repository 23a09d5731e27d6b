"""pIC, the paper's baseline: probabilistic iterative correspondence (Montesano, Minguez, Montano, IROS 2005).

The displacement q and every point are Gaussian. For each new point, all statistically compatible reference points are
combined into one virtual partner, with mean and covariance. Gauss-Newton then minimises the Mahalanobis distances to
the partners. The displacement's new covariance starts the next iteration. It serves experiments only: it has no
surfaces and no light, and its covariance trusts pairs along a wall.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.numerics.symmetric3 import solve3
from estimator.scan_matching import icp
from estimator.scan_matching.distance_axis import ray_distance2, turn_of

COMPATIBLE = 5.991
"""Squared Mahalanobis distance of compatible points: chi-squared, 2 degrees of freedom, 95 %."""

LEAST, SHRINK = 4.0, 0.25
"""Smallest displacement of a point by the displacement's covariance, in sigmas of a point.

SHRINK: smallest factor on that variance per iteration.
"""

CAP, NOISE, ACROSS, SETTLED, EYE_X, EYE_Y = range(6)
"""Indices in ``how``: iteration cap, range noise, bearing noise (rad), final step (m), lidar in the base frame."""

Reference = tuple[Array, Ints, Array]
"""Rows, start and rays of the axis, centred on the reference's lidar."""

Spread = tuple[float, float, float]
"""Covariance of a point: xx, xy, yy."""


@kernel("UniTuple(f8, 3)(f8, f8, f8, f8)", inner=True)
def spread_of(x: float, y: float, sigma: float, across: float) -> Spread:
    """Covariance of a point seen at (x, y) from the lidar: ``sigma`` along the ray, ``across`` (rad) over it."""
    r2 = x * x + y * y
    if r2 == 0.0:
        return sigma * sigma, 0.0, sigma * sigma
    a, b = sigma * sigma / r2, across * across
    return a * x * x + b * y * y, (a - b) * x * y, a * y * y + b * x * x


@kernel("UniTuple(f8, 3)(f8, f8, f8[:, ::1])", inner=True)
def swung(ux: float, uy: float, P: Array) -> Spread:
    """``J_q P J_q'``: covariance of a point at lever (ux, uy) by the pose's covariance."""
    ax, ay = P[0, 2] - uy * P[2, 2], P[1, 2] + ux * P[2, 2]
    return (
        P[0, 0] - uy * P[0, 2] - uy * ax,
        P[0, 1] + ux * P[0, 2] - uy * ay,
        P[1, 1] + ux * P[1, 2] + ux * ay,
    )


@kernel("f8(UniTuple(f8, 3))", inner=True)
def widest(S: Spread) -> float:
    """Larger eigenvalue of a covariance."""
    half = 0.5 * (S[0] - S[2])
    return float(0.5 * (S[0] + S[2]) + np.sqrt(half * half + S[1] * S[1]))


@kernel("void(f8[:, ::1], UniTuple(i8, 2), Tuple((f8, f8, f8, f8, f8, f8, f8)), UniTuple(f8, 2), f8[::1])", inner=True)
def gather(
    rows: Array,
    part: tuple[int, int],
    at: tuple[float, float, float, float, float, float, float],
    noise: tuple[float, float],
    sums: Array,
) -> None:
    """Add the compatible points of one sector's axis, rows [low, high), to a new point's virtual partner.

    ``at``: predicted point (x, y), its distance from the centre, covariance (3), largest distance of a compatible
    point. ``sums``: of pi; pi times x, y, xx, xy, yy relative to the predicted point; pi times the points' covariance
    (3); pi squared.
    """
    x, y, r, xx, xy, yy, reach = at
    a, b = part
    while a < b:
        m = (a + b) >> 1
        if rows[m, 2] < r - reach:
            a = m + 1
        else:
            b = m
    while a < part[1] and rows[a, 2] <= r + reach:
        dx, dy = rows[a, 0] - x, rows[a, 1] - y
        if dx * dx + dy * dy <= reach * reach:
            pxx, pxy, pyy = spread_of(rows[a, 0], rows[a, 1], noise[0], noise[1])
            sxx, sxy, syy = xx + pxx, xy + pxy, yy + pyy
            det = sxx * syy - sxy * sxy
            d2 = (syy * dx * dx - 2.0 * sxy * dx * dy + sxx * dy * dy) / det
            if d2 <= COMPATIBLE:
                pi = np.exp(-0.5 * d2) / np.sqrt(det)
                sums[0] += pi
                sums[1] += pi * dx
                sums[2] += pi * dy
                sums[3] += pi * dx * dx
                sums[4] += pi * dx * dy
                sums[5] += pi * dy * dy
                sums[6] += pi * pxx
                sums[7] += pi * pxy
                sums[8] += pi * pyy
                sums[9] += pi * pi
        a += 1


@kernel(
    "void(Tuple((f8[:, ::1], i8[::1], f8[:, ::1])), Tuple((f8, f8, f8, f8, f8, f8, f8)), UniTuple(f8, 2), f8[::1])",
    inner=True,
)
def partners(
    reference: Reference,
    at: tuple[float, float, float, float, float, float, float],
    noise: tuple[float, float],
    sums: Array,
) -> None:
    """Sum the compatible set of a point, over the sectors that can contain it; arguments as in :func:`gather`."""
    rows, start, rays = reference
    sums[:] = 0.0
    x, y, r2, reach2 = at[0], at[1], at[2] * at[2], at[6] * at[6]
    sectors = len(start) - 1
    home = min(sectors - 1, int(turn_of(x, y) * 0.25 * sectors)) if sectors > 1 else 0
    gather(rows, (start[home], start[home + 1]), at, noise, sums)
    left, todo = home, sectors - 1
    while todo > 0:
        left = left + 1 if left + 1 < sectors else 0
        if ray_distance2(rays, left, x, y, r2) > reach2:
            break
        gather(rows, (start[left], start[left + 1]), at, noise, sums)
        todo -= 1
    right = home
    while todo > 0:
        if ray_distance2(rays, right, x, y, r2) > reach2:
            break
        right = right - 1 if right > 0 else sectors - 1
        gather(rows, (start[right], start[right + 1]), at, noise, sums)
        todo -= 1


@kernel("void(f8[::1], UniTuple(f8, 3), UniTuple(f8, 4), f8[:, ::1], f8[::1])", inner=True)
def add_partner(s: Array, spread: Spread, ray: tuple[float, float, float, float], A: Array, b: Array) -> None:
    """Add one virtual partner to the normal equations; b (3..) also gets inliers, pairs, weights and squares.

    ``s``: of :func:`gather`. ``spread``: of the predicted point. ``ray``: its lever from the base, and its direction
    from the lidar.
    """
    ex, ey = s[1] / s[0], s[2] / s[0]
    xx = spread[0] + (s[3] + s[6]) / s[0] - ex * ex
    xy = spread[1] + (s[4] + s[7]) / s[0] - ex * ey
    yy = spread[2] + (s[5] + s[8]) / s[0] - ey * ey
    det = xx * yy - xy * xy
    wxx, wxy, wyy = yy / det, -xy / det, xx / det
    ux, uy = ray[0], ray[1]
    tx, ty = wxx * -uy + wxy * ux, wxy * -uy + wyy * ux
    fx, fy = wxx * ex + wxy * ey, wxy * ex + wyy * ey
    A[0, 0] += wxx
    A[0, 1] += wxy
    A[1, 1] += wyy
    A[0, 2] += tx
    A[1, 2] += ty
    A[2, 2] += ux * ty - uy * tx
    b[0] += fx
    b[1] += fy
    b[2] += ux * fy - uy * fx
    b[3] += 1.0 if ex * fx + ey * fy < COMPATIBLE else 0.0
    b[4] += 1.0
    b[5] += 1.0 + s[9] / (s[0] * s[0])
    b[6] += (ex * ray[2] + ey * ray[3]) ** 2


@kernel(
    "void(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1])), f8[::1], f8[:, ::1], f8[::1],"
    " Tuple((f8[:, ::1], f8[::1])))",
    inner=True,
)
def sum_up(points: Array, reference: Reference, T: Array, P: Array, how: Array, out: tuple[Array, Array]) -> None:
    """Normal equations over all virtual partners at the pose ``T`` with covariance ``P``; ``out``: A, and b (7)."""
    A, b = out
    A[:], b[:] = 0.0, 0.0
    noise = (how[NOISE], how[ACROSS])
    c, s = np.cos(T[2]), np.sin(T[2])
    sums = np.empty(10)
    for i in range(len(points)):
        ux, uy = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        lx, ly = points[i, 0] - how[EYE_X], points[i, 1] - how[EYE_Y]
        lx, ly = c * lx - s * ly, s * lx + c * ly
        of_pose, of_point = swung(ux, uy, P), spread_of(lx, ly, noise[0], noise[1])
        spread = (of_pose[0] + of_point[0], of_pose[1] + of_point[1], of_pose[2] + of_point[2])
        x, y = ux + T[0], uy + T[1]
        r = np.sqrt(x * x + y * y)
        bound = np.sqrt(COMPATIBLE * widest(spread))
        blur = max(noise[0], noise[1] * (r + 2.0 * bound))
        reach = np.sqrt(COMPATIBLE * (widest(spread) + blur * blur))
        partners(reference, (x, y, r, spread[0], spread[1], spread[2], reach), noise, sums)
        if sums[0] > 0.0:
            length = np.sqrt(lx * lx + ly * ly) + 1e-12
            add_partner(sums, spread, (ux, uy, lx / length, ly / length), A, b)
    A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1])), f8[::1], f8[:, ::1], f8[::1],"
    " Tuple((f8[:, ::1], f8[::1], f8[:, ::1])))",
    aside=True,
)
def iterate(
    points: Array, reference: Reference, T: Array, P: Array, how: Array, out: tuple[Array, Array, Array]
) -> int:
    """Iterate pIC from ``T`` (base in the reference lidar's frame, changed in place); returns the iterations.

    ``P``: the displacement's covariance, which sets the size of the compatible sets. It shrinks during the iteration,
    no faster than the steps and never below ``LEAST`` sigmas of a point. A set must contain points on either side along
    a wall, or the virtual partner pulls along it. The solution's own covariance would shrink at once, and the iteration
    would stop early. ``out``: information, sums and trace in the layout of `icp`.
    """
    H, sums, trace = out
    P = P.copy()
    b, step, before = np.empty(7), np.empty(3), np.zeros(3)
    lever = max(0.1, icp.mean_lever(points, how[EYE_X : EYE_Y + 1]))
    damping, count, least = 1.0, 0, LEAST**2 * (how[NOISE] ** 2 + (lever * how[ACROSS]) ** 2)
    sums[icp.SETTLED] = 0.0
    while count < how[CAP] and sums[icp.SETTLED] == 0.0:
        row = trace[count]
        count += 1
        sum_up(points, reference, T, P, how, (H, b))
        sums[icp.INLIERS : icp.SQUARES + 1] = b[3:]
        row[icp.AT_X], row[icp.AT_Y], row[icp.AT_YAW] = T[0], T[1], T[2]
        spread2 = P[0, 0] + P[1, 1] + lever * lever * P[2, 2]
        row[icp.SCALE] = row[icp.GATE] = np.sqrt(COMPATIBLE * spread2)
        row[icp.FITTED : icp.SQUARED + 1] = b[3:]
        row[icp.STRIDE], row[icp.SOUGHT], row[icp.STEP2], row[icp.DAMPED] = 1.0, float(len(points)), 0.0, 0.0
        if solve3(H, b, step) == 0.0:
            break
        length = np.sqrt(step[0] ** 2 + step[1] ** 2 + (lever * step[2]) ** 2)
        back = step[0] * before[0] + step[1] * before[1] + lever * lever * step[2] * before[2]
        if back < -0.25 * length * length:
            damping = max(0.125, 0.5 * damping)
        for i in range(3):
            T[i] += damping * step[i]
            before[i] = step[i]
        sums[icp.LENGTH2], sums[icp.DAMPING] = (length / how[SETTLED]) ** 2, damping
        row[icp.STEP2], row[icp.DAMPED] = sums[icp.LENGTH2], damping
        sums[icp.SETTLED] = 1.0 if length < how[SETTLED] and spread2 <= 1.01 * least else 0.0
        shrink = min(1.0, max(least, SHRINK * spread2, length * length) / spread2)
        for i in range(3):
            for j in range(3):
                P[i, j] *= shrink
    return count
