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
