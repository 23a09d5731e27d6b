"""Scans that no lidar can have measured are refused before anything is computed from them, and it is said why.

A bearing or a mount that is no number would become an index in the kernels; an angle of millions of turns has no digits
left for the beams, which then fall together to a scan that fits anywhere; arrays that do not belong together, or a
sweep that ends before it begins, come from a program and not from the world.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.measurements import Scan
from estimator.numerics.arrays import Array
from estimator.result import Reason
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.match_memory import MatchMemory

LONGEST_SWEEP_S = 10.0
FARTHEST_MOUNT_M = 100.0
LARGEST_NOISE_M = 1.0
LATEST_S = 1e11
"""No clock of a robot, and no stamp of a log, is three thousand years from its zero."""
FULL_TURN = 2.0 * math.pi + 0.1
"""Bearings of one sweep span no more than this; nor is one of them, or a mount's yaw, farther from zero."""


def refused(matching: MatchMemory, scan: Scan) -> Reason | None:
    """Why a scan may not be looked at, None if it may; what has been found good of it is remembered."""
    if not (well_formed(scan) and even(matching, scan.bearing_rad)):
        return Reason.MALFORMED
    late = scan.t_end < matching.t_newest_scan
    matching.t_newest_scan = scan.t_end
    return Reason.LATE if late else None


def well_formed(scan: Scan) -> bool:
    """Whether arrays, times, mount and noise of a scan can be those of a sweep."""
    shape = scan.bearing_rad.shape
    for values, dtype in ((scan.bearing_rad, np.float64), (scan.range_m, np.float64), (scan.beam, np.uint8)):
        if values.shape != shape or values.dtype != dtype or not values.flags.c_contiguous:
            return False
    mount = scan.T_base_lidar
    if len(shape) != 1 or mount.shape != (3,) or mount.dtype != np.float64 or not mount.flags.c_contiguous:
        return False
    x, y, yaw = mount.tolist()
    placed = math.hypot(x, y) < FARTHEST_MOUNT_M and abs(yaw) <= FULL_TURN
    timed = in_time(scan.t_end) and 0.0 <= scan.t_end - scan.t_begin < LONGEST_SWEEP_S
    return placed and timed and 0.0 <= scan.sigma_m < LARGEST_NOISE_M


def even(matching: MatchMemory, bearing: Array) -> bool:
    """Whether bearings run one way, within a turn; looked at once for all scans that share the array."""
    if bearing is matching.bearing_rad or len(bearing) < 2:
        return True
    steps = np.diff(bearing) if np.isfinite(bearing).all() else np.zeros(1)
    one_way = bool((steps > 0.0).all() or (steps < 0.0).all())
    first, last = float(bearing[0]), float(bearing[-1])
    if not one_way or max(abs(first), abs(last), abs(last - first)) > FULL_TURN:
        return False
    matching.bearing_rad = bearing
    return True


def nothing_of(scan: Scan) -> ScanPoints:
    """What is seen of a scan that may not be looked at."""
    return ScanPoints(np.empty((0, 2)), np.zeros(2), 0.0, scan.sigma_m)


def in_time(t_mono: float) -> bool:
    """Whether an instant can be one; a pose that was carried to another would be out of time for good."""
    return abs(t_mono) < LATEST_S
