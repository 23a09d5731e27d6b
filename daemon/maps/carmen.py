"""Keyframe export as a CARMEN log (carmen.sourceforge.net/logger_playback.html): one ``ROBOTLASER1`` line per scan.

The format has no field for a keyframe's time, and a map of several days has no clock of its own. The stamp is the
keyframe's number, as if one were created each second: ascending, unique, and equal to that in the TUM file.
Bearings are those at the scan's end, so that the robot does not turn within a scan.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import numpy as np

from estimator import Array, Beam, Beams, se2

HEAD: Final = (
    "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"
    "# ROBOTLASER1 laser_type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode "
    "num_readings [range_readings] num_remissions [remission values] laser_pose_x laser_pose_y laser_pose_theta "
    "robot_pose_x robot_pose_y robot_pose_theta laser_tv laser_rv forward_safety_dist side_safety_dist turn_axis\n"
    "# the time stamp is the keyframe's number\n"
)
HOST: Final = "lumiloop"
BEYOND_M: Final = 1.0
"""Margin in m of the written maximum range above the farthest reading: such a reading means a beam without echo."""


def carmen(scans: Iterable[tuple[int, Array, Array, Beams]]) -> bytes:
    """CARMEN log of keyframes: number, T_map_base, T_base_lidar, beams. FREE and NONE beams both have no return."""
    lines = [HEAD]
    for key, T_map_base, T_base_lidar, (bearing, distance, kind) in scans:
        n = len(bearing)
        if n > 1 and bearing[-1] < bearing[0]:
            bearing, distance, kind = bearing[::-1], distance[::-1], kind[::-1]
        hit = (kind == Beam.HIT) & np.isfinite(distance) & (distance > 0.0)
        longest = math.ceil(float(distance[hit].max(initial=1.0)) + BEYOND_M)
        ranges = np.where(hit, distance, longest)
        step = float(bearing[-1] - bearing[0]) / max(1, n - 1)
        setup = f"0 {bearing[0]:.9f} {step * (n - 1):.9f} {step:.12f} {longest:d} 0.01 0"
        poses = (*se2.compose(T_map_base, T_base_lidar).tolist(), *T_map_base.tolist())
        read = " ".join([f"{value:.4f}" for value in ranges.tolist()])
        placed = " ".join([f"{value:.6f}" for value in poses])
        lines.append(f"ROBOTLASER1 {setup} {n} {read} 0 {placed} 0 0 0 0 0 {key:.6f} {HOST} {key:.6f}\n")
    return "".join(lines).encode()
