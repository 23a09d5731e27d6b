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


@dataclass(slots=True, eq=False)
class ScanPoints:
    """Surface points of one scan in the base frame at the scan's end.

    Attributes:
        xy: (n, 2) metres, in order of measurement. beam: (n,) index of the beam each came from.
        origin: (x, y) of the lidar in the base frame.
        spacing_rad: angle between neighbouring beams. sigma_m: one-sigma range noise.
    """

    xy: Array
    beam: npt.NDArray[np.int64]
    origin: Array
    spacing_rad: float
    sigma_m: float


@kernel("i8(Tuple((f8[::1], f8[::1], u1[::1], f8[::1])), f8[::1], f8[::1], f8, f8, Tuple((f8[:, ::1], i8[::1])))")
def place_beams(
    beams: tuple[Array, Array, npt.NDArray[np.uint8], Array],
    T_base_lidar: Array,
    twist: Array,
    far: float,
    quality: float,
    out: tuple[Array, npt.NDArray[np.int64]],
) -> int:
    """Keep the beams that pass the filter and carry each from its own instant to the scan's end; count of points.

    ``twist`` is the constant body motion over the scan; beam i of n lies
    ``(n - 1 - i) / (n - 1)`` of it before the end.
    """
    bearing, distance, kind, intensity = beams
    xy, index = out
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
        index[kept] = i
        kept += 1
    return kept


def points_of(scan: Scan, motion: Array, far: float, quality: float) -> ScanPoints:
    """Filter, deskew with ``motion`` (base motion from the first to the last beam) and mount a scan."""
    n = len(scan.bearing_rad)
    xy = np.empty((n, 2))
    index = np.empty(n, np.int64)
    intensity = NO_INTENSITY if scan.intensity is None else scan.intensity
    beams = (scan.bearing_rad, scan.range_m, scan.beam, intensity)
    kept = place_beams(beams, scan.T_base_lidar, se2.log(motion), far, quality, (xy, index))
    spacing = abs(float(scan.bearing_rad[-1] - scan.bearing_rad[0])) / (n - 1) if n > 1 else 0.0
    return ScanPoints(xy[:kept], index[:kept], scan.T_base_lidar[:2], spacing, scan.sigma_m)


@kernel("void(f8[:, ::1], f8[::1], f8, f8, f8[:, ::1])")
def fit_normals(xy: Array, origin: Array, spacing: float, reach: float, normals: Array) -> None:
    """Total-least-squares line through each point's neighbours; normal towards the sensor, (0, 0) where there is none.

    Neighbours along the scan lie within ``reach`` or 2.5 beam spacings of the point, whichever is more: a metric window
    where beams are dense, a fixed count where they are sparse.
    """
    n = len(xy)
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        r = np.sqrt((x - origin[0]) ** 2 + (y - origin[1]) ** 2)
        window = max(reach, 2.5 * spacing * r)
        limit2 = window * window
        count = 1.0
        sx = sy = sxx = sxy = syy = 0.0
        for side in (-1, 1):
            j = i + side
            while 0 <= j < n:
                dx, dy = xy[j, 0] - x, xy[j, 1] - y
                if dx * dx + dy * dy > limit2:
                    break
                count += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                j += side
        normals[i, 0] = normals[i, 1] = 0.0
        if count < 3.0:
            continue
        cxx = sxx / count - (sx / count) ** 2
        cxy = sxy / count - sx * sy / (count * count)
        cyy = syy / count - (sy / count) ** 2
        half = 0.5 * (cxx - cyy)
        root = np.sqrt(half * half + cxy * cxy)
        small = 0.5 * (cxx + cyy) - root
        large = 0.5 * (cxx + cyy) + root
        if not large > 0.0 or small > 0.1 * large:
            continue
        angle = 0.5 * np.arctan2(2.0 * cxy, cxx - cyy)
        nx, ny = -np.sin(angle), np.cos(angle)
        if nx * (origin[0] - x) + ny * (origin[1] - y) < 0.0:
            nx, ny = -nx, -ny
        normals[i, 0] = nx
        normals[i, 1] = ny


def normals_of(points: ScanPoints, reach: float = 0.12) -> Array:
    """Normals (n, 2) of a scan's points, zero where the surface is no line."""
    normals = np.empty_like(points.xy)
    fit_normals(points.xy, points.origin, points.spacing_rad, reach, normals)
    return normals
