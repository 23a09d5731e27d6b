"""From a scan to points: quality filter (Q, L), deskew, mount, surface normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator import se2
from estimator.kernel import kernel
from estimator.records import Array, Beam, Scan

HIT: int = int(Beam.HIT)
NO_INTENSITY: Array = np.empty(0)
MAX_SLOPE = 0.03
FLAT = 0.03
FEW = 2
GAP = 0.5


@dataclass(slots=True, eq=False)
class ScanPoints:
    """Surface points of one scan in the base frame at the scan's end.

    Attributes:
        xy: (n, 2) metres, in order of measurement. origin: (x, y) of the lidar in the base frame.
        turned_rad: yaw turned from the first to the last beam. sigma_m: one-sigma range noise.
    """

    xy: Array
    origin: Array
    turned_rad: float
    sigma_m: float


@kernel("i8(Tuple((f8[::1], f8[::1], u1[::1], f8[::1])), f8[::1], f8[::1], f8, f8, f8[:, ::1])")
def place_beams(
    beams: tuple[Array, Array, npt.NDArray[np.uint8], Array],
    T_base_lidar: Array,
    twist: Array,
    far: float,
    quality: float,
    xy: Array,
) -> int:
    """Keep the beams that pass the filter and carry each from its own instant to the scan's end; count of points.

    ``twist`` is the constant body motion over the scan; beam i of n lies
    ``(n - 1 - i) / (n - 1)`` of it before the end.
    """
    bearing, distance, kind, intensity = beams
    n = len(bearing)
    mx, my, myaw = T_base_lidar[0], T_base_lidar[1], T_base_lidar[2]
    moving = twist[0] != 0.0 or twist[1] != 0.0 or twist[2] != 0.0
    kept = 0
    for i in range(n):
        r = distance[i]
        if kind[i] != 1 or not (0.0 < r <= far) or not np.isfinite(bearing[i]):
            continue
        if len(intensity) == n and intensity[i] < quality:
            continue
        a = bearing[i] + myaw
        x = mx + r * np.cos(a)
        y = my + r * np.sin(a)
        if moving:
            f = -(n - 1 - i) / (n - 1.0)
            w = f * twist[2]
            c, s = np.cos(w), np.sin(w)
            u = f * (twist[0] - 0.5 * w * twist[1])
            v = f * (twist[1] + 0.5 * w * twist[0])
            x, y = u + c * x - s * y, v + s * x + c * y
        xy[kept, 0] = x
        xy[kept, 1] = y
        kept += 1
    return kept


def points_of(scan: Scan, motion: Array, far: float, quality: float) -> ScanPoints:
    """Filter, deskew with ``motion`` (base motion from the first to the last beam) and mount a scan."""
    n = len(scan.bearing_rad)
    xy = np.empty((n, 2))
    intensity = NO_INTENSITY if scan.intensity is None else scan.intensity
    beams = (scan.bearing_rad, scan.range_m, scan.beam, intensity)
    kept = place_beams(beams, scan.T_base_lidar, se2.log(motion), far, quality, xy)
    return ScanPoints(xy[:kept], np.ascontiguousarray(scan.T_base_lidar[:2]), float(motion[2]), scan.sigma_m)


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
        if i < count and (lines[i, 0] - lines[i - 1, 0]) ** 2 + (lines[i, 1] - lines[i - 1, 1]) ** 2 < GAP * GAP:
            continue
        dx, dy = lines[i - 1, 0] - lines[begin, 0], lines[i - 1, 1] - lines[begin, 1]
        lines[begin:i, 5] = np.sqrt(dx * dx + dy * dy)
        begin = i


@kernel("i8(f8[:, ::1], f8[::1], f8, f8, f8[:, ::1])")
def fit_lines(xy: Array, origin: Array, sigma: float, reach: float, lines: Array) -> int:
    """Total-least-squares line through each point's neighbours along the scan; the number of lines found.

    A row of ``lines`` is the point moved onto its line (x, y), the normal towards the sensor (x, y), the variance of
    the normal's direction in rad^2, and the extent of the unbroken run it belongs to in m. Neighbours lie within
    ``reach``, or are the next two beams on either side: a metric window where beams are dense, a fixed count where they
    are sparse. A point whose neighbours are no line is left out.
    """
    n = len(xy)
    found = 0
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        limit2 = reach * reach
        count = 1.0
        sx = sy = sxx = sxy = syy = 0.0
        low = high = i
        for side in (-1, 1):
            j = i + side
            while 0 <= j < n:
                dx, dy = xy[j, 0] - x, xy[j, 1] - y
                d2 = dx * dx + dy * dy
                if d2 > limit2 and (abs(j - i) > FEW or d2 > GAP * GAP):
                    break
                count += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                j += side
            if side < 0:
                low = j + 1
            else:
                high = j
        if count < 3.0:
            continue
        mx, my = sx / count, sy / count
        cxx = sxx / count - mx * mx
        cxy = sxy / count - mx * my
        cyy = syy / count - my * my
        half = 0.5 * (cxx - cyy)
        root = np.sqrt(half * half + cxy * cxy)
        small = 0.5 * (cxx + cyy) - root
        large = 0.5 * (cxx + cyy) + root
        noise2 = max(sigma * sigma, small)
        slope = noise2 / (count * large) if large > 0.0 else 1.0
        if not slope < MAX_SLOPE or (small > FLAT * large and small > (3.0 * sigma) ** 2):
            continue
        angle = 0.5 * np.arctan2(2.0 * cxy, cxx - cyy)
        nx, ny = -np.sin(angle), np.cos(angle)
        if nx * (origin[0] - x) + ny * (origin[1] - y) < 0.0:
            nx, ny = -nx, -ny
        shift = offset_on_line(xy, low, high, (x, y, nx, ny))
        lines[found, 0] = x + shift * nx
        lines[found, 1] = y + shift * ny
        lines[found, 2] = nx
        lines[found, 3] = ny
        lines[found, 4] = slope
        found += 1
    measure_runs(lines, found)
    return found


def lines_of(points: ScanPoints, reach: float = 0.12) -> Array:
    """Line elements (n, 6) of a scan in the base frame: see :func:`fit_lines`."""
    lines = np.empty((len(points.xy), 6))
    found = fit_lines(points.xy, points.origin, points.sigma_m, reach, lines)
    return lines[:found]
