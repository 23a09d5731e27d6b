"""A rectangular room seen by an ideal lidar: raw scans for tests that need a pose that moves, and nothing finer."""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry

Pose = tuple[float, float, float]
Floats = npt.NDArray[np.float64]
Path = Callable[[Floats], Floats]
"""Poses (3, n) of the robot in the room at n times."""

HALF_X, HALF_Y = 2.6, 1.9
PILLAR = (1.6, 0.9, 0.25)

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


def drive(times: Floats) -> Floats:
    """A gentle curve through the room, at rest for the first second."""
    t = np.maximum(0.0, times - 1.0)
    return np.array((0.8 * np.sin(0.25 * t), 0.5 * (1.0 - np.cos(0.25 * t)), 0.4 * np.sin(0.4 * t)))


def rest(times: Floats) -> Floats:
    """Not moving at all."""
    return drive(np.zeros_like(times))


def at(t: float, path: Path) -> Pose:
    """Pose on the path at one time."""
    x, y, yaw = path(np.array([t]))[:, 0].tolist()
    return x, y, yaw


def ranges_m(angle: Floats, x: Floats, y: Floats) -> Floats:
    """Distance along each ray (world angle) from each origin: four walls and a pillar."""
    c, s = np.cos(angle), np.sin(angle)
    to_x = (np.copysign(HALF_X, c) - x) / np.where(c == 0, 1e-12, c)
    to_y = (np.copysign(HALF_Y, s) - y) / np.where(s == 0, 1e-12, s)
    px, py, r = PILLAR[0] - x, PILLAR[1] - y, PILLAR[2]
    along = px * c + py * s
    inside = r * r - (px * px + py * py - along * along)
    pillar = np.where((along > 0) & (inside > 0), along - np.sqrt(np.maximum(0.0, inside)), np.inf)
    return np.asarray(np.minimum(np.minimum(to_x, to_y), pillar))


def raw_scan(seq: int, t_mono: float, path: Path = drive, geometry: LidarGeometry = URG) -> RawScan:
    """What the lidar reports when its first beam is at ``t_mono``; every beam from where the robot then is."""
    count = geometry.amax - geometry.amin + 1
    times = t_mono + geometry.beam_dt_s * np.arange(count)
    x, y, yaw = path(times)
    measured = np.rint(ranges_m(geometry.bearings(geometry.amin, 1, count) + yaw, x, y) / geometry.range_unit_m)
    ranges = measured.astype(np.int32)
    return RawScan(
        geometry=geometry,
        seq=seq,
        t_rx=float(times[-1]) + 0.002,
        t_mono=t_mono,
        t_sigma=0.001,
        t_tick=round(t_mono * 1000) % 2**24,
        first_step=geometry.amin,
        stride=1,
        ranges=ranges,
        code=np.full(count, VALID, dtype=np.int32),
    )


def raw_odometry(t_mono: float, path: Path = drive) -> RawOdometry:
    """True odometry, counted from the room's origin."""
    return RawOdometry(t_mono, t_mono, *at(t_mono, path))


def error(pose: Pose, t_mono: float, path: Path = drive) -> tuple[float, float]:
    """Distance in m and heading difference in rad between a pose in the map and the truth; the map starts at rest."""
    x0, y0, yaw0 = at(0.0, path)
    x, y, yaw = at(t_mono, path)
    c, s = math.cos(yaw0), math.sin(yaw0)
    dx, dy = x - x0, y - y0
    true = (c * dx + s * dy, c * dy - s * dx, yaw - yaw0)
    return math.hypot(pose[0] - true[0], pose[1] - true[1]), abs(math.remainder(pose[2] - true[2], math.tau))
