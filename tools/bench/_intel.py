"""Consecutive scans of a CARMEN log, with what the wheels say of the way between them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from daemon.bridge import ScanBridge
from daemon.config import LidarConfig
from estimator import se2
from estimator.records import Array, Scan
from hal.odometry import RawOdometry
from hal.replay.carmen import read_carmen


@dataclass(frozen=True, eq=False)
class Step:
    """Two scans in a row and the motion of the robot between them as its wheels have it."""

    before: Scan
    after: Scan
    wheels: Array


def consecutive(path: Path, count: int, least_m: float = 0.01, least_rad: float = 0.005) -> list[Step]:
    """``count`` steps, evenly over the log, of those in which the robot moved by at least so much."""
    log = read_carmen(path)
    bridge = ScanBridge(LidarConfig())
    bridge.T_base_lidar = np.array(log.mount)
    raw, poses, pose = [], [], None
    for event in log.events(0.0):
        if isinstance(event, RawOdometry):
            pose = np.array((event.x, event.y, event.yaw))
        elif pose is not None:
            raw.append(event)
            poses.append(pose)
    ways = [se2.between(a, b) for a, b in pairwise(poses)]
    moving = [i for i, w in enumerate(ways) if np.hypot(w[0], w[1]) > least_m or abs(w[2]) > least_rad]
    chosen = [moving[i] for i in np.linspace(0, len(moving) - 1, count).astype(int)]
    return [Step(bridge.scan(raw[i]), bridge.scan(raw[i + 1]), ways[i]) for i in chosen]
