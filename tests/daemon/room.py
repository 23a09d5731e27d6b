"""A rectangular room seen by an ideal lidar: raw scans for tests that need a pose that moves, and nothing finer."""

from __future__ import annotations

import math

import numpy as np

from hal.lidar import VALID, LidarGeometry, RawScan

HALF_X, HALF_Y = 4.0, 3.0

URG = LidarGeometry(
    model="URG-04LX",
    serial="H0500000",
    firmware="3.3.00",
    ares=1024,
    afrt=384,
    amin=44,
    amax=725,
    dmin=20,
    dmax=5600,
    range_unit_m=0.001,
    period_s=0.1,
    beam_dt_s=0.1 / 1024,
)


def ranges_mm(pose: tuple[float, float, float], geometry: LidarGeometry = URG) -> np.ndarray:
    """Distances in range units from a pose in the room (origin in its middle), a pillar breaking the symmetry."""
    count = geometry.amax - geometry.amin + 1
    angle = geometry.bearings(geometry.amin, 1, count) + pose[2]
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0, (HALF_X - pose[0]) / c, (-HALF_X - pose[0]) / c)
        to_y = np.where(s > 0, (HALF_Y - pose[1]) / s, (-HALF_Y - pose[1]) / s)
    distance = np.minimum(to_x, to_y)
    px, py, r = 2.5 - pose[0], 1.5 - pose[1], 0.3
    along = px * c + py * s
    off2 = px * px + py * py - along * along
    hit = (along > 0) & (off2 < r * r)
    distance = np.where(hit, along - np.sqrt(np.maximum(0.0, r * r - off2)), distance)
    return np.rint(np.minimum(distance, 60.0) / geometry.range_unit_m)


def raw_scan(seq: int, t_mono: float, pose: tuple[float, float, float], geometry: LidarGeometry = URG) -> RawScan:
    """What the lidar would report from this pose, held still during the scan; too far is no distance."""
    measured = ranges_mm(pose, geometry).astype(np.int32)
    valid = measured <= geometry.dmax
    duration = geometry.beam_dt_s * len(measured)
    return RawScan(
        geometry=geometry,
        seq=seq,
        t_rx=t_mono + duration,
        t_mono=t_mono,
        t_sigma=0.001,
        t_tick=round(t_mono * 1000) % 2**24,
        first_step=geometry.amin,
        stride=1,
        ranges=np.where(valid, measured, 0).astype(np.int32),
        code=np.where(valid, VALID, measured).astype(np.int32),
    )


def drive(t: float) -> tuple[float, float, float]:
    """A gentle curve through the room, at rest for the first second."""
    t = max(0.0, t - 1.0)
    return 1.2 * math.sin(0.25 * t), 0.8 * (1.0 - math.cos(0.25 * t)), 0.3 * math.sin(0.4 * t)
