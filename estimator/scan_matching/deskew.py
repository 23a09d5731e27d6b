"""Deskewed surface points of a scan in the base frame: quality filter (Q, L of the paper), deskew, mount."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from estimator.measurements import Beam, Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

HIT: int = int(Beam.HIT)
NO_INTENSITY: Array = np.empty(0)

FRESH = 64
"""Beams after which sine and cosine are computed again, so that rounding does not accumulate."""

CHORD_M, SPARSE_M = 0.15, 0.3
"""Length (m) of the chord for a point's tangent, ten times the noise of a good range sensor.

SPARSE_M: largest distance (m) of an adjacent point that replaces a missing chord end.
"""


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
    """Write the deskewed points of the beams that pass the filter to ``xy``; returns their number.

    ``twist`` is the constant body motion (m, m, rad) over the scan. Beam i of n precedes the end by the share ``(n - 1
    - i) / (n - 1)`` of it.
    Bearings of a device are evenly spaced, so a rotation of the previous beam gives the next sine and cosine. A small
    deviation from even spacing is corrected to first order, with an error below 1e-10. A large one is computed
    directly.
    """
    bearing, distance, kind, intensity = beams
    n = len(bearing)
    mx, my, myaw = T_base_lidar[0], T_base_lidar[1], T_base_lidar[2]
    moving = n > 1 and (twist[0] != 0.0 or twist[1] != 0.0 or twist[2] != 0.0)
    last = max(n - 1.0, 1.0)
    step, turn = (bearing[n - 1] - bearing[0]) / last if n > 0 else 0.0, twist[2] / last
    cos_step, sin_step, cos_turn, sin_turn = np.cos(step), np.sin(step), np.cos(turn), np.sin(turn)
    even = cos_even = sin_even = c = s = 0.0
    kept = 0
    for i in range(n):
        if i % FRESH == 0:
            even, w = bearing[i] + myaw, (i - last) * turn
            cos_even, sin_even, c, s = np.cos(even), np.sin(even), np.cos(w), np.sin(w)
        else:
            even += step
            cos_even, sin_even = cos_even * cos_step - sin_even * sin_step, sin_even * cos_step + cos_even * sin_step
            c, s = c * cos_turn - s * sin_turn, s * cos_turn + c * sin_turn
        r = distance[i]
        if kind[i] != HIT or not (0.0 < r <= far) or not np.isfinite(bearing[i]):
            continue
        if len(intensity) == n and intensity[i] < quality:
            continue
        d = bearing[i] + myaw - even
        if abs(d) < 1e-5:
            x = mx + r * (cos_even - d * sin_even)
            y = my + r * (sin_even + d * cos_even)
        else:
            x, y = mx + r * np.cos(bearing[i] + myaw), my + r * np.sin(bearing[i] + myaw)
        if moving:
            f = (i - last) / last
            w = f * twist[2]
            u = f * (twist[0] - 0.5 * w * twist[1])
            v = f * (twist[1] + 0.5 * w * twist[0])
            x, y = u + c * x - s * y, v + s * x + c * y
        xy[kept, 0] = x
        xy[kept, 1] = y
        kept += 1
    return kept


def points_of(scan: Scan, motion: Array, far: float, quality: float) -> ScanPoints:
    """Filter, deskew and mount a scan; ``motion`` is the base motion (m, m, rad) from the first to the last beam.

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
    """Write every ``stride``-th point with the unit tangent of its surface: rows (x, y, t_x, t_y) of ``out``.

    The tangent is the chord of the surrounding points, or of the adjacent beams where they are sparse. It only has to
    distinguish the two walls of a corner. It is (0, 0) where the chord is too short.
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
    """At most ``most`` points, evenly selected, with their tangents: (n, 4), see :func:`orient`."""
    n = len(points.xy)
    stride = max(1, -(-n // max(1, most)))
    out = np.empty((-(-n // stride), 4))
    orient(points.xy, stride, out)
    return out


def unturned(bearing_rad: Array, turned_rad: float) -> Array:
    """Bearings (rad) as the lidar would measure them without its rotation during the scan, in its frame at the end."""
    n = len(bearing_rad)
    if turned_rad == 0.0 or n < 2:
        return bearing_rad
    return np.asarray(bearing_rad - turned_rad * _to_come(n))


@lru_cache(maxsize=4)
def _to_come(n: int) -> Array:
    """Share of the scan that remains after each of its ``n`` beams, 1 to 0."""
    return np.asarray(1.0 - np.arange(n) / (n - 1))
