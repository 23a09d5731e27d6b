"""Point-to-line ICP (Eq. 13) on the distance-region axis, with the prediction weighted in at each iteration (Eq. 14).

Eq. 14 adds transforms as matrices, which leaves the group of rigid motions. Here the weight is the matrix ``W = (L1 +
L2)^-1 L1``. L1 is the information of the prediction T1, L2 that of the lidar T2. So in a corridor the prediction
determines the long axis, and in a room the lidar determines everything.

The lidar's information must not be too large. Normals are fitted to noisy points, so a smooth wall seems to constrain
the pose along itself as well. The expected size of that part is known, because each normal has the variance of its
direction; it is subtracted. A direction without significant information is left to the prediction.
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.numerics.symmetric3 import eigen3, positive, solve3
from estimator.scan_matching.nearest_neighbour import glance, nearest, search

GRAZE = 0.2
"""Share of the range noise across a surface that remains at a grazing angle: footprint, roughness, bearing error."""

ASKEW = 0.6
"""Sine of the largest angle between the surfaces of a point and its partner, 37 deg; this allows a heading error."""

SHRINK = 2.0
"""Robust scale in units of a point's displacement in the last step."""

INLIERS, PAIRS, WEIGHTS, SQUARES, SETTLED, LENGTH2, DAMPING = range(15, 22)
"""Indices of further entries in the sums of the normal equations; ``SUMS`` entries in all."""

SUMS = 22

AT_X, AT_Y, AT_YAW, SCALE, GATE, STRIDE, FITTED, PAIRED, WEIGHED, SQUARED, STEP2, DAMPED, SOUGHT = range(13)
"""Columns of the trace, one row an iteration; STRIDE is the point stride, SOUGHT the number of searches.

AT_X, AT_Y, AT_YAW: initial pose, relative to the axis centre. SCALE, GATE: robust scale and gate, m. FITTED to SQUARED:
inliers, pairs, weights and squares as in its sums. STEP2, DAMPED: squared step length in sigma, and damping; 0 without
a step. A search runs for each point that has left its safe radius.
"""

TRACE = 13

Reference = tuple[Array, Ints, Array, Array]
"""Rows, start and rays of the axis; per row the normal x, y, the variance of the normal's direction, and the weight."""

PX, PY, EX, EY, TX, TY = range(6)
"""Rows of the queries (6, n): position, unit vector towards the lidar, tangent, all in the base frame."""

NX, NY, OFFSET, SLOPE, WEIGHT = range(5)
"""Rows of the partners' lines (5, n): normal, its product with a point on the line, direction variance, weight.

A weight of 0 marks a query without a partner.
"""

Memory = tuple[Ints, Ints, Array, Array]
"""Per query: its partner (a row, or -1); the row of its last search; a safe radius; the partners' lines (5, n).

The third array holds the query's position (x, y) at the last search. Its third column is the squared distance that the
query may move until another row can be nearest.
"""


def memory_of(queries: int) -> Memory:
    """Memory of queries that have not been searched yet."""
    return np.full(queries, -1), np.full(queries, -1), np.zeros((queries, 3)), np.zeros((5, queries))


def paired(points: Array, reference: Reference, row: Array) -> Ints:
    """Row of the axis paired with each point (n, 4) in the iteration of a trace's row, or -1."""
    coarse = int(row[STRIDE])
    body, memory = np.empty((6, len(points))), memory_of(len(points))
    lay_out(points, 0.0, 0.0, coarse, body)
    pair_up(body, reference, row[:3].copy(), row[GATE] ** 2, -(-len(points) // coarse), memory)
    out = np.full(len(points), -1)
    out[::coarse] = memory[0][: -(-len(points) // coarse)]
    return out


@kernel("f8(f8[:, ::1], f8, f8, i8, f8[:, ::1])")
def lay_out(points: Array, ex: float, ey: float, coarse: int, body: Array) -> float:
    """Write points (n, 4) as columns, every ``coarse``-th of them first, with directions to the lidar at (ex, ey).

    Returns their root mean square distance from the lidar: metres of displacement per radian.
    """
    n, at, square = len(points), 0, 0.0
    for first in range(coarse):
        for i in range(first, n, coarse):
            x, y = points[i, 0], points[i, 1]
            dx, dy = ex - x, ey - y
            r2 = dx * dx + dy * dy
            inverse = 1.0 / np.sqrt(r2) if r2 > 0.0 else 0.0
            body[PX, at], body[PY, at], body[EX, at], body[EY, at] = x, y, dx * inverse, dy * inverse
            body[TX, at], body[TY, at] = points[i, 2], points[i, 3]
            square += r2
            at += 1
    return float(np.sqrt(square / max(n, 1)))


@kernel("void(f8[:, ::1], f8[:, ::1], i8, i8, f8[:, ::1])")
def hold(rows: Array, lines: Array, row: int, i: int, held: Array) -> None:
    """Copy the line of a row (-1: none) to column ``i`` of ``held``, where :func:`sum_up` reads it."""
    if row < 0:
        held[WEIGHT, i] = 0.0
        return
    nx, ny = lines[row, 0], lines[row, 1]
    held[NX, i], held[NY, i] = nx, ny
    held[OFFSET, i] = nx * rows[row, 0] + ny * rows[row, 1]
    held[SLOPE, i], held[WEIGHT, i] = lines[row, 2], lines[row, 3]


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8, i8,"
    " Tuple((i8[::1], i8[::1], f8[:, ::1], f8[:, ::1])))"
)
def pair_up(body: Array, reference: Reference, T: Array, gate2: float, count: int, memory: Memory) -> int:
    """Step 1 of Sect. 4.2: nearest row within the gate for each of the first ``count`` queries at pose ``T``.

    A query within its safe radius keeps its row without a search. Returns the number of searches.
    """
    rows, start, rays, lines = reference
    partner, found, safe, held = memory
    c, s, x, y = np.cos(T[2]), np.sin(T[2]), T[0], T[1]
    sought = 0
    for i in range(count):
        px = c * body[PX, i] - s * body[PY, i] + x
        py = s * body[PX, i] + c * body[PY, i] + y
        row = found[i]
        if row >= 0 and (px - safe[i, 0]) ** 2 + (py - safe[i, 1]) ** 2 < safe[i, 2]:
            d2 = (px - rows[row, 0]) ** 2 + (py - rows[row, 1]) ** 2
            if d2 >= gate2:
                row = -1
        else:
            row, d2, e2 = glance(rows, start, rays, px, py, gate2)
            if e2 < d2:
                row, d2, e2, _ = search(rows, start, rays, px, py, row, d2)
            found[i] = row
            safe[i, 0], safe[i, 1] = px, py
            safe[i, 2] = 0.25 * (np.sqrt(e2) - np.sqrt(d2)) ** 2
            sought += 1
        if row != partner[i]:
            partner[i] = row
            hold(rows, lines, row, i, held)
    return sought


@kernel("void(f8[:, ::1], f8[:, ::1], f8[::1], f8, i8, f8[::1])")
def sum_up(body: Array, held: Array, T: Array, scale: float, queries: int, sums: Array) -> None:
    """Step 2 of Sect. 4.2: the normal equations of point-to-line over the pairs of the first queries.

    A pair does not count if the point sees the surface from behind (the other side of a thin wall). Nor does it count
    where the two surfaces lie at a large angle (the other wall of a corner).
    ``scale``: robust scale, m. ``sums``: 6 of the information, 6 of its expected noise part, 3 of the gradient; then
    inliers, pairs, robust weights, and squares (m^2, scaled to range noise).

    The loop has no branches and runs over columns, so that the compiler can vectorise it.
    """
    px, py, ex, ey, tx, ty = body[PX], body[PY], body[EX], body[EY], body[TX], body[TY]
    nx, ny, offset, slope, weight = held[NX], held[NY], held[OFFSET], held[SLOPE], held[WEIGHT]
    c, s, x, y = np.cos(T[2]), np.sin(T[2]), T[0], T[1]
    k = 1.0 / (scale * scale)
    h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    n00 = n01 = n02 = n11 = n12 = n22 = 0.0
    g0 = g1 = g2 = inliers = count = weights = squares = 0.0
    for i in range(queries):
        u, v = nx[i], ny[i]
        bx, by = c * u + s * v, c * v - s * u  # the normal in the base frame
        cosine = bx * ex[i] + by * ey[i]
        use = (weight[i] > 0.0) & (cosine > 0.0) & (abs(bx * tx[i] + by * ty[i]) <= ASKEW)
        one = 1.0 if use else 0.0
        along, turn = bx * px[i] + by * py[i], by * px[i] - bx * py[i]
        e = along + u * x + v * y - offset[i]
        q = GRAZE + (1.0 - GRAZE) * cosine * cosine  # variance of e in units of the range noise's: 1 / precision
        z = one / (q + k * e * e)
        w = z * q
        count += one
        inliers += 1.0 if w > 0.2 else 0.0
        weights += w
        z *= weight[i]
        ze = z * e
        squares += ze * e
        h00, h01, h02 = h00 + z * u * u, h01 + z * u * v, h02 + z * u * turn
        h11, h12, h22 = h11 + z * v * v, h12 + z * v * turn, h22 + z * turn * turn
        g0, g1, g2 = g0 + ze * u, g1 + ze * v, g2 + ze * turn
        z *= slope[i]
        n00, n01, n02 = n00 + z * v * v, n01 - z * u * v, n02 - z * v * along
        n11, n12, n22 = n11 + z * u * u, n12 + z * u * along, n22 + z * along * along
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = h00, h01, h02, h11, h12, h22
    sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = n00, n01, n02, n11, n12, n22
    sums[12], sums[13], sums[14] = g0, g1, g2
    sums[15], sums[16], sums[17], sums[18] = inliers, count, weights, squares


@kernel("void(f8[::1], f8, f8[:, ::1], f8[:, ::1])", inner=True)
def trusted(sums: Array, k: float, H: Array, keep: Array) -> None:
    """Information without the normals' noise, times ``k``, to ``H``; projector on its directions to ``keep``.

    A direction counts when its information is more than twice the part that noise alone explains. That test needs no
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
    """Root mean square distance (m) of the points from the lidar: metres of displacement per radian."""
    square = 0.0
    for i in range(len(points)):
        square += (points[i, 0] - eye[0]) ** 2 + (points[i, 1] - eye[1]) ** 2
    return float(np.sqrt(square / max(len(points), 1)))


@kernel("f8(f8[::1], f8[:, ::1], f8[::1])", inner=True)
def between(u: Array, A: Array, v: Array) -> float:
    """``u' A v`` of two steps (3,) with the information A (3, 3)."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += u[i] * A[i, j] * v[j]
    return total


@kernel("void(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8, f8[:, ::1])")
def see_across(points: Array, reference: Reference, T: Array, scale: float, out: Array) -> None:
    """Write the amount of visible and of matching surface across each direction at pose ``T``, from the points (n, 4).

    ``out`` (2, 3): sums of xx, xy, yy over the unit vectors across the tangents. Row 0 is over all points. Row 1 is
    over those whose partner's line lies within two ``scale`` and runs along the same direction.
    """
    rows, start, rays, lines = reference
    c, s, gate = np.cos(T[2]), np.sin(T[2]), max(6.0 * scale, 0.1)
    out[:] = 0.0
    for i in range(len(points)):
        px = c * points[i, 0] - s * points[i, 1] + T[0]
        py = s * points[i, 0] + c * points[i, 1] + T[1]
        ax, ay = -s * points[i, 2] - c * points[i, 3], c * points[i, 2] - s * points[i, 3]
        out[0, 0] += ax * ax
        out[0, 1] += ax * ay
        out[0, 2] += ay * ay
        row, _, _ = nearest(rows, start, rays, px, py, gate * gate)
        if row < 0:
            continue
        nx, ny = lines[row, 0], lines[row, 1]
        off = nx * (px - rows[row, 0]) + ny * (py - rows[row, 1])
        if abs(off) < 2.0 * scale and abs(nx * ay - ny * ax) < ASKEW:
            out[1, 0] += ax * ax
            out[1, 1] += ax * ay
            out[1, 2] += ay * ay


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])), f8[::1], f8[:, ::1], f8[::1],"
    " Tuple((f8[:, ::1], f8[::1], f8[:, ::1])))",
    aside=True,
)
def iterate(
    points: Array, reference: Reference, T: Array, L1: Array, how: Array, out: tuple[Array, Array, Array]
) -> int:
    """Iterate Eq. 13-14 from ``T`` (relative to the axis centre, changed in place); returns the number of iterations.

    The robust scale starts at twice the displacement of a point by the prediction's uncertainty. It shrinks to a few
    times the noise, not faster than the steps do. Every ``coarse``-th point is used until an iteration near the last
    scale. A step that reverses the previous one is halved, because pairs may alternate between two sets.
    ``how``: lidar in the base frame (x, y), iteration cap, gate, last scale, noise, smallest step in sigma, coarse
    stride. ``out``: the lidar's information (3, 3); the sums of the last pass with SETTLED, LENGTH2 (squared length of
    the last step in sigma) and DAMPING; the trace (cap, TRACE), a row an iteration.
    """
    H, sums, trace = out
    n, coarse = len(points), int(how[7])
    T1, before = T.copy(), np.zeros(3)
    A, keep, b, step = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    body, memory = np.empty((6, n)), (np.full(n, -1), np.full(n, -1), np.empty((n, 3)), np.zeros((5, n)))
    lever = lay_out(points, how[0], how[1], coarse, body)
    last = how[4]
    spread = np.sqrt(1.0 / L1[0, 0] + 1.0 / L1[1, 1] + lever * lever / L1[2, 2])
    scale, stride, damping, count = min(max(last, 2.0 * spread), 0.5 * how[3]), coarse, 1.0, 0
    sums[SETTLED] = 0.0
    while count < how[2] and sums[SETTLED] == 0.0:
        row = trace[count]
        count += 1
        few, k = (n + stride - 1) // stride, stride / (how[5] * how[5])
        gate = min(how[3], max(6.0 * scale, 0.1))
        row[AT_X], row[AT_Y], row[AT_YAW], row[SCALE], row[GATE], row[STRIDE] = T[0], T[1], T[2], scale, gate, stride
        row[SOUGHT] = pair_up(body, reference, T, gate * gate, few, memory)
        sum_up(body, memory[3], T, scale, few, sums)
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
        sums[SETTLED] = 1.0 if length2 < how[6] * how[6] and scale == last and stride == 1 else 0.0
        if scale <= 2.0 * last:
            stride = 1
        moved = np.sqrt(step[0] * step[0] + step[1] * step[1]) + lever * abs(step[2])
        scale = max(last, min(scale, max(0.25 * scale, SHRINK * moved)))
    return count
