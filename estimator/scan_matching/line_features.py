"""Line elements of a scan: surface point, normal and its direction variance, fitted to the neighbours of each point."""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel
from estimator.scan_matching.deskew import ScanPoints

REACH_M, REACH_SIGMAS = 0.12, 8.0
"""Radius (m) of the neighbours in a fit, or that many times the noise.

It is long enough for a direction despite range noise, and short enough for furniture. A window that the noise itself
cuts short selects points with the same error.
"""

SPACING_M, OFF_M = 0.018, 0.06
"""Spacing (m) of lines along a surface, a thirteenth of the fitted length.

OFF_M: distance (m) off the last line beyond which a point belongs to another surface.
"""

FEW, GAP_M = 2, 0.5
"""Neighbours on either side where beams are sparser, and their largest distance (m)."""

STEEPEST = 0.03
"""Largest variance of a usable direction, rad^2 (10 deg)."""

FLAT = 0.03
"""Largest share of a line's variance across it, unless range noise explains it."""


@kernel("Tuple((i8, i8))(f8[:, ::1], i8, f8)", inner=True)
def neighbours(xy: Array, i: int, reach: float) -> tuple[int, int]:
    """Range [low, high) of the points around point ``i``, in scan order, that may lie on its surface."""
    n = len(xy)
    x, y = xy[i, 0], xy[i, 1]
    low, high = i, i + 1
    while low > 0:
        d2 = (xy[low - 1, 0] - x) ** 2 + (xy[low - 1, 1] - y) ** 2
        if d2 > reach * reach and (i - low >= FEW or d2 > GAP_M * GAP_M):
            break
        low -= 1
    while high < n:
        d2 = (xy[high, 0] - x) ** 2 + (xy[high, 1] - y) ** 2
        if d2 > reach * reach and (high - i > FEW or d2 > GAP_M * GAP_M):
            break
        high += 1
    return low, high


@kernel("void(f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1])", inner=True)
def add_up(xy: Array, eye: Array, sums: Array, columns: Array) -> None:
    """Write running sums of x, y, xx, xy, yy relative to the ``eye``: row i of ``sums`` (n + 1, 5) is over i points.

    The points (n, 2) are also written as ``columns`` (2, n).

    At a range of 80 m, rounding removes 3e-10 m^2 from the variance. That is a thousandth of the effect of a tenth of a
    millimetre.
    """
    sx = sy = sxx = sxy = syy = 0.0
    for i in range(len(xy)):
        sums[i, 0], sums[i, 1], sums[i, 2], sums[i, 3], sums[i, 4] = sx, sy, sxx, sxy, syy
        columns[0, i], columns[1, i] = xy[i, 0], xy[i, 1]
        x, y = xy[i, 0] - eye[0], xy[i, 1] - eye[1]
        sx, sy, sxx, sxy, syy = sx + x, sy + y, sxx + x * x, sxy + x * y, syy + y * y
    n = len(xy)
    sums[n, 0], sums[n, 1], sums[n, 2], sums[n, 3], sums[n, 4] = sx, sy, sxx, sxy, syy


@kernel("Tuple((f8, f8, f8, f8))(f8[:, ::1], i8, i8)", inner=True)
def line_through(sums: Array, low: int, high: int) -> tuple[float, float, float, float]:
    """Total-least-squares line of the points [low, high): normal (x, y), variance across it and along it (m^2)."""
    part = 1.0 / (high - low)
    mx, my = (sums[high, 0] - sums[low, 0]) * part, (sums[high, 1] - sums[low, 1]) * part
    cxx = (sums[high, 2] - sums[low, 2]) * part - mx * mx
    cxy = (sums[high, 3] - sums[low, 3]) * part - mx * my
    cyy = (sums[high, 4] - sums[low, 4]) * part - my * my
    half = 0.5 * (cxx - cyy)
    root = np.sqrt(half * half + cxy * cxy)
    mean = 0.5 * (cxx + cyy)
    tx, ty = (half + root, cxy) if half >= 0.0 else (cxy, root - half)
    length2 = tx * tx + ty * ty
    if length2 == 0.0:
        return 0.0, 0.0, mean, mean
    inverse = 1.0 / np.sqrt(length2)
    return -ty * inverse, tx * inverse, max(0.0, mean - root), mean + root


@kernel("f8(f8[:, ::1], i8, i8, Tuple((f8, f8, f8, f8)))", inner=True)
def offset_on_line(columns: Array, low: int, high: int, at: tuple[float, float, float, float]) -> float:
    """Offset (m) along the normal of a parabola through the points [low, high), at the point ``at`` (x, y, normal).

    A line through the points of a column would lie inside it; a parabola does not.
    """
    x, y, nx, ny = at
    m1 = m2 = m3 = m4 = v0 = v1 = v2 = 0.0
    n = float(high - low)
    xs, ys = columns[0, low:high], columns[1, low:high]
    for j in range(len(xs)):
        dx, dy = xs[j] - x, ys[j] - y
        u, v = ny * dx - nx * dy, nx * dx + ny * dy
        uu = u * u
        m1 += u
        m2 += uu
        m3 += uu * u
        m4 += uu * uu
        v0 += v
        v1 += v * u
        v2 += v * uu
    a, b, c = m2 * m4 - m3 * m3, m1 * m4 - m2 * m3, m1 * m3 - m2 * m2
    det = n * a - m1 * b + m2 * c
    if n < 5.0 or not det > 1e-9 * n * m2 * m4:
        det = n * m2 - m1 * m1
        return (v0 * m2 - v1 * m1) / det if det > 0.0 else v0 / n
    return (v0 * a - v1 * b + v2 * c) / det


@kernel("void(f8[:, ::1], i8)", inner=True)
def measure_runs(lines: Array, count: int) -> None:
    """Write into column 5 the distance (m) between the ends of each unbroken run of lines."""
    begin = 0
    for i in range(1, count + 1):
        if i < count and (lines[i, 0] - lines[i - 1, 0]) ** 2 + (lines[i, 1] - lines[i - 1, 1]) ** 2 < GAP_M * GAP_M:
            continue
        dx, dy = lines[i - 1, 0] - lines[begin, 0], lines[i - 1, 1] - lines[begin, 1]
        lines[begin:i, 5] = np.sqrt(dx * dx + dy * dy)
        begin = i


@kernel("i8(f8[:, ::1], f8[::1], f8, f8[:, ::1])", aside=True)
def fit_lines(xy: Array, eye: Array, sigma: float, lines: Array) -> int:
    """Fit a line to the neighbours of each point, where they lie on a surface; returns the number of lines.

    A row of ``lines`` begins with the point on its surface (x, y) and the normal towards the ``eye``. Then follow the
    variance of the normal's direction (rad^2) and the extent of its unbroken run (m).
    """
    found, reach = 0, max(REACH_M, REACH_SIGMAS * sigma)
    sums, columns = np.empty((len(xy) + 1, 5)), np.empty((2, len(xy)))
    add_up(xy, eye, sums, columns)
    last_x = last_y = nx = ny = 0.0
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        dx, dy = x - last_x, y - last_y
        if found > 0 and abs(nx * dy - ny * dx) < SPACING_M and abs(nx * dx + ny * dy) < OFF_M:
            continue
        low, high = neighbours(xy, i, reach)
        count = float(high - low)
        if count < 3.0:
            continue
        ax, ay, across, along = line_through(sums, low, high)
        direction = max(sigma * sigma, across) / (count * along) if along > 0.0 else 1.0
        if not direction < STEEPEST or (across > FLAT * along and across > 9.0 * sigma * sigma):
            continue
        nx, ny = (-ax, -ay) if ax * (eye[0] - x) + ay * (eye[1] - y) < 0.0 else (ax, ay)
        shift = offset_on_line(columns, low, high, (x, y, nx, ny))
        last_x, last_y = x + shift * nx, y + shift * ny
        lines[found, 0], lines[found, 1], lines[found, 2], lines[found, 3] = last_x, last_y, nx, ny
        lines[found, 4] = direction
        found += 1
    measure_runs(lines, found)
    return found


def lines_of(points: ScanPoints) -> Array:
    """Line elements (n, 6) of a scan in the base frame: see :func:`fit_lines`."""
    lines = np.empty((len(points.xy), 6))
    return lines[: fit_lines(points.xy, points.origin, points.sigma_m, lines)]
