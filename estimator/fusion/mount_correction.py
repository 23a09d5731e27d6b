"""Correction of the lidar mount by its estimated error (`wheel_calibration`), where that is large.

With a mount error M, scans give ``T_odom_base M`` instead of ``T_odom_base``. The correction multiplies later mounts by
M and the present pose by its inverse. So the lidar stays where it is, and the heading of the base changes once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_model import Motion
from estimator.fusion.wheel_calibration import LARGE, SOUND, Errors, WheelCalibration
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.result import SlowError
from estimator.scan_matching.match_memory import MatchMemory


def remounted(wheels: WheelCalibration, scan: Scan) -> Scan:
    """The scan with the corrected mount."""
    if not wheels.mount.any() or not np.isfinite(scan.T_base_lidar).all():
        return scan
    return replace(scan, T_base_lidar=se2.compose(wheels.mount, scan.T_base_lidar))


def correct(wheels: WheelCalibration, motion: Motion, matching: MatchMemory, pose: MapPose) -> bool:
    """Apply a remaining error of a mount with a large one; returns whether the heading has changed."""
    x, sigma = wheels.errors.x, float(wheels.errors.P[SlowError.MOUNT_YAW, SlowError.MOUNT_YAW]) ** 0.5
    large = wheels.mount.any() or (wheels.told is not None and wheels.told.large[SlowError.MOUNT_YAW])
    if not large or abs(float(x[SlowError.MOUNT_YAW])) < max(SOUND[SlowError.MOUNT_YAW], LARGE * sigma):
        return False
    M = np.array((0.0, x[SlowError.MOUNT_Y], x[SlowError.MOUNT_YAW]))
    back = se2.inverse(M)
    wheels.mount = se2.compose(M, wheels.mount)
    motion.T_odom_base = se2.compose(motion.T_odom_base, back)
    motion.velocity = se2.rotation(float(M[2])) @ motion.velocity
    matching.T_odom_scan = se2.compose(matching.T_odom_scan, back)
    matching.T_odom_match = se2.compose(matching.T_odom_match, back)
    if pose.alignment is not None:
        pose.alignment.poses.poses.clear()
    off = np.zeros(5)
    off[[SlowError.MOUNT_YAW, SlowError.MOUNT_Y]] = x[[SlowError.MOUNT_YAW, SlowError.MOUNT_Y]]
    wheels.errors, wheels.recent, wheels.former = (
        Errors(one.x - off, one.P) for one in (wheels.errors, wheels.recent, wheels.former)
    )
    wheels.begun = wheels.waiting = None
    wheels.jumped = 0.0
    wheels.gyro.restart()
    return True
