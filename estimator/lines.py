"""Line elements: what a scan's points say about the surfaces they lie on."""

from __future__ import annotations

import numpy as np

from estimator.kernel import kernel
from estimator.records import Array
from estimator.scanpoints import ScanPoints

REACH_M, REACH_SIGMAS = 0.12, 8.0
"""Neighbours this near are used, or within so many times the noise: long enough for a direction out of range noise,
short enough for furniture. A window that noise itself cuts short picks the points that lie wrong in the same way."""

FEW, GAP_M = 2, 0.5
"""Where beams are sparser than that, so many neighbours on either side, if they are no farther away than this."""

STEEPEST = 0.03
"""Largest variance of a direction worth having, rad^2 (10 deg)."""

FLAT = 0.03
"""Largest share of a line's variance across it, unless range noise explains it."""


@kernel("Tuple((i8, i8))(f8[:, ::1], i8, f8)")
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


@kernel("Tuple((f8, f8, f8, f8))(f8[:, ::1], i8, i8, i8)")
def line_through(xy: Array, i: int, low: int, high: int) -> tuple[float, float, float, float]:
    """Total-least-squares line of the points [low, high): normal (x, y), variance across it and along it."""
    x, y = xy[i, 0], xy[i, 1]
    sx = sy = sxx = sxy = syy = 0.0
    for j in range(low, high):
        dx, dy = xy[j, 0] - x, xy[j, 1] - y
        sx += dx
        sy += dy
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
    n = float(high - low)
    mx, my = sx / n, sy / n
    cxx, cxy, cyy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
    half = 0.5 * (cxx - cyy)
    root = np.sqrt(half * half + cxy * cxy)
    mean = 0.5 * (cxx + cyy)
    tx, ty = (half + root, cxy) if half >= 0.0 else (cxy, root - half)
    length = np.sqrt(tx * tx + ty * ty)
    if length == 0.0:
        return 0.0, 0.0, mean, mean
    return -ty / length, tx / length, max(0.0, mean - root), mean + root


@kernel("f8(f8[:, ::1], i8, i8, Tuple((f8, f8, f8, f8)))")
def offset_on_line(xy: Array, low: int, high: int, at: tuple[float, float, float, float]) -> float:
    """Offset along the normal, at the point ``at`` (x, y, normal), of a parabola through the points [low, high).

    A parabola and not a line: a line through points of a column would lie inside it.
    """
    x, y, nx, ny = at
    m1 = m2 = m3 = m4 = v0 = v1 = v2 = 0.0
    n = float(high - low)
    for j in range(low, high):
        dx, dy = xy[j, 0] - x, xy[j, 1] - y
        u, v = ny * dx - nx * dy, nx * dx + ny * dy
        uu = u * u
        m1 += u
        m2 += uu
        m3 += uu * u
        m4 += uu * uu
        v0 += v
        v1 += v * u
        v2 += v * uu
    det = n * (m2 * m4 - m3 * m3) - m1 * (m1 * m4 - m2 * m3) + m2 * (m1 * m3 - m2 * m2)
    if n < 5.0 or not det > 1e-9 * n * m2 * m4:
        det = n * m2 - m1 * m1
        return (v0 * m2 - v1 * m1) / det if det > 0.0 else v0 / n
    return (v0 * (m2 * m4 - m3 * m3) - m1 * (v1 * m4 - m3 * v2) + m2 * (v1 * m3 - m2 * v2)) / det


@kernel("void(f8[:, ::1], i8)")
def measure_runs(lines: Array, count: int) -> None:
    """Write into column 5 how far apart the ends of each unbroken run of lines are."""
    begin = 0
    for i in range(1, count + 1):
        if i < count and (lines[i, 0] - lines[i - 1, 0]) ** 2 + (lines[i, 1] - lines[i - 1, 1]) ** 2 < GAP_M * GAP_M:
            continue
        dx, dy = lines[i - 1, 0] - lines[begin, 0], lines[i - 1, 1] - lines[begin, 1]
        lines[begin:i, 5] = np.sqrt(dx * dx + dy * dy)
        begin = i


@kernel("i8(f8[:, ::1], f8[::1], f8, f8[:, ::1])")
def fit_lines(xy: Array, eye: Array, sigma: float, lines: Array) -> int:
    """A line through the surroundings of each point, left out where they are none; the number found.

    A row of ``lines`` is the point moved onto its surface (x, y), the normal towards the ``eye`` (x, y), the variance
    of the normal's direction in rad^2, and the extent of the unbroken run it belongs to in m.
    """
    found, reach = 0, max(REACH_M, REACH_SIGMAS * sigma)
    for i in range(len(xy)):
        low, high = neighbours(xy, i, reach)
        count = float(high - low)
        if count < 3.0:
            continue
        nx, ny, across, along = line_through(xy, i, low, high)
        direction = max(sigma * sigma, across) / (count * along) if along > 0.0 else 1.0
        if not direction < STEEPEST or (across > FLAT * along and across > 9.0 * sigma * sigma):
            continue
        x, y = xy[i, 0], xy[i, 1]
        if nx * (eye[0] - x) + ny * (eye[1] - y) < 0.0:
            nx, ny = -nx, -ny
        shift = offset_on_line(xy, low, high, (x, y, nx, ny))
        lines[found, 0] = x + shift * nx
        lines[found, 1] = y + shift * ny
        lines[found, 2] = nx
        lines[found, 3] = ny
        lines[found, 4] = direction
        found += 1
    measure_runs(lines, found)
    return found


def lines_of(points: ScanPoints) -> Array:
    """Line elements (n, 6) of a scan in the base frame: see :func:`fit_lines`."""
    lines = np.empty((len(points.xy), 6))
    return lines[: fit_lines(points.xy, points.origin, points.sigma_m, lines)]
