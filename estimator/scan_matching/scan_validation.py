"""Scan validation: rejects scans that no lidar can have measured, with a reason, before any computation.

A non-finite bearing or mount would become an array index in the kernels. At an angle of millions of turns rounding
merges the beams into a scan that fits anywhere. So do beams that all have about one bearing: their ends lie on a line,
which fits every wall. A scan that repeats another one to the last bit, although the wheels have moved the robot, is no
new measurement: range noise alone makes every scan different. Arrays of different lengths, or a scan that ends before
it begins, are program errors.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.measurements import Beam, Odometry, Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import Reason
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.match_memory import MatchMemory

LONGEST_SWEEP_S = 10.0
FARTHEST_MOUNT_M = 100.0
LARGEST_NOISE_M = 1.0
LATEST_S = 1e11
"""Largest plausible instant, s: about three thousand years from the zero of a clock."""
FULL_TURN = 2.0 * math.pi + 0.1
"""Largest span of the bearings of one scan, and largest magnitude of a bearing or of a mount's yaw, rad."""

NARROWEST = 0.5
"""Smallest field of a scan, rad: a third of the narrowest lidar's, and of a depth camera's that is used as one."""
FEW = 32
"""Beams up to which a scan may be narrower, because the matcher finds too few points in it."""
MOVED_M, MOVED_RAD = 0.05, 0.05
"""Motion (m, rad) that changes every scan by more than the resolution of the worst lidar."""


def refused(matching: MatchMemory, scan: Scan) -> Reason | None:
    """Reason to reject a scan, None if it is valid; updates the newest scan end and the validated bearings."""
    if not (well_formed(scan) and even(matching, scan.bearing_rad)):
        return Reason.MALFORMED
    late = scan.t_end < matching.t_newest_scan
    matching.t_newest_scan = scan.t_end
    if late:
        return Reason.LATE
    return Reason.REPEATED if repeated(matching, scan) else None


def on_odometry(matching: MatchMemory, record: Odometry) -> None:
    """Add a motion of the wheels since the first of the scans that are alike."""
    if np.isfinite(record.delta).all():
        matching.driven = matching.driven + record.delta


def repeated(matching: MatchMemory, scan: Scan) -> bool:
    """Whether a scan equals the ones before it although the robot has moved; few returns may be equal by chance."""
    few = int(np.count_nonzero(scan.beam == Beam.HIT)) <= FEW
    if few or not np.array_equal(scan.range_m, matching.first_alike, equal_nan=True):
        matching.first_alike, matching.driven = scan.range_m, se2.identity()
        return False
    x, y, yaw = matching.driven.tolist()
    return math.hypot(x, y) > MOVED_M or abs(yaw) > MOVED_RAD


def well_formed(scan: Scan) -> bool:
    """Whether arrays, times, mount and noise of a scan are plausible."""
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
    """Whether bearings are monotonic, spread, and within a turn; an array that several scans share is checked once."""
    if bearing is matching.bearing_rad or len(bearing) < 2:
        return True
    steps = np.diff(bearing) if np.isfinite(bearing).all() else np.zeros(1)
    one_way = bool((steps > 0.0).all() or (steps < 0.0).all())
    first, last = float(bearing[0]), float(bearing[-1])
    if not one_way or narrow(bearing) or max(abs(first), abs(last), abs(last - first)) > FULL_TURN:
        return False
    matching.bearing_rad = bearing
    return True


def narrow(bearing: Array) -> bool:
    """Whether half of the beams or more lie within half of the smallest field."""
    n = len(bearing)
    return n > FEW and abs(float(bearing[(3 * n) // 4] - bearing[n // 4])) < 0.49 * NARROWEST


def nothing_of(scan: Scan) -> ScanPoints:
    """Empty points of a rejected scan."""
    return ScanPoints(np.empty((0, 2)), np.zeros(2), 0.0, scan.sigma_m)


def in_time(t_mono: float) -> bool:
    """Whether an instant is plausible; a pose predicted to an implausible one could never return."""
    return abs(t_mono) < LATEST_S
