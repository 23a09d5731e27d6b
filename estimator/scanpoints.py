"""From a scan to points: quality filter (Q, L of the paper), deskew, mount."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator import se2
from estimator.kernel import kernel
from estimator.records import Array, Beam, Scan

HIT: int = int(Beam.HIT)
NO_INTENSITY: Array = np.empty(0)

CHORD_M, SPARSE_M = 0.15, 0.3
"""Length over which a point's tangent is taken: ten times the noise of a good range sensor."""


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

    ``twist`` is the constant body motion over the scan; beam i of n is ``(n - 1 - i) / (n - 1)`` of it before the end.
    """
    bearing, distance, kind, intensity = beams
    n = len(bearing)
    mx, my, myaw = T_base_lidar[0], T_base_lidar[1], T_base_lidar[2]
    moving = n > 1 and (twist[0] != 0.0 or twist[1] != 0.0 or twist[2] != 0.0)
    kept = 0
    for i in range(n):
        r = distance[i]
        if kind[i] != HIT or not (0.0 < r <= far) or not np.isfinite(bearing[i]):
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
    """Filter, deskew with ``motion`` (base motion from the first to the last beam) and mount a scan.

    Raises:
        ValueError: the scan's arrays differ in length, which no device can cause.
    """
    n = len(scan.bearing_rad)
    if len(scan.range_m) != n or len(scan.beam) != n:
        raise ValueError(
            f"scan {scan.seq} has {n} bearings, {len(scan.range_m)} ranges and {len(scan.beam)} beam kinds"
        )
    xy = np.empty((n, 2))
    intensity = NO_INTENSITY if scan.intensity is None else scan.intensity
    beams = (scan.bearing_rad, scan.range_m, scan.beam, intensity)
    kept = place_beams(beams, scan.T_base_lidar, se2.log(motion), far, quality, xy)
    return ScanPoints(xy[:kept], np.ascontiguousarray(scan.T_base_lidar[:2]), float(motion[2]), scan.sigma_m)


@kernel("void(f8[:, ::1], i8, f8[:, ::1])")
def orient(xy: Array, stride: int, out: Array) -> None:
    """Every ``stride``-th point with the unit tangent of its surface: rows (x, y, t_x, t_y) of ``out``.

    The tangent is the chord of the points around it, or of the next beams where they are sparse; it only has to tell
    one wall of a corner from the other. It is (0, 0) where the chord is too short to say.
    """
    n = len(xy)
    low = high = 0
    for k in range(len(out)):
        i = k * stride
        x, y = xy[i, 0], xy[i, 1]
        while low < i and (xy[low, 0] - x) ** 2 + (xy[low, 1] - y) ** 2 > 0.25 * CHORD_M * CHORD_M:
            low += 1
        high = max(high, i)
        while high + 1 < n and (xy[high + 1, 0] - x) ** 2 + (xy[high + 1, 1] - y) ** 2 < 0.25 * CHORD_M * CHORD_M:
            high += 1
        a, b = low, high
        if a == i and i > 0 and (xy[i - 1, 0] - x) ** 2 + (xy[i - 1, 1] - y) ** 2 < SPARSE_M * SPARSE_M:
            a = i - 1
        if b == i and i + 1 < n and (xy[i + 1, 0] - x) ** 2 + (xy[i + 1, 1] - y) ** 2 < SPARSE_M * SPARSE_M:
            b = i + 1
        dx, dy = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
        length = np.sqrt(dx * dx + dy * dy)
        known = length > 0.4 * CHORD_M
        out[k, 0], out[k, 1] = x, y
        out[k, 2] = dx / length if known else 0.0
        out[k, 3] = dy / length if known else 0.0


def oriented(points: ScanPoints, most: int) -> Array:
    """At most ``most`` of the points, evenly, with their tangents: (n, 4), see :func:`orient`."""
    n = len(points.xy)
    stride = max(1, -(-n // max(1, most)))
    out = np.empty((-(-n // stride), 4))
    orient(points.xy, stride, out)
    return out
