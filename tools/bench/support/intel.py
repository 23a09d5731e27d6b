"""A CARMEN log for timing: scans in a row with what the wheels say of the way between them, and whole steps."""

import statistics
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from daemon.config.schema import LidarConfig
from daemon.devices.conversion import OdometryBridge, ScanBridge
from estimator.measurements import UNLIMITED, Array, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import new_state, step
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


def front_end(path: Path, scans: int) -> float:
    """Milliseconds of one core that the estimator's step takes for a scan and its odometry, median of the first scans.

    From the records to the fused pose: placing, matching against the local map, keyframes and map where they are due.
    """
    log, wheels = read_carmen(path), OdometryBridge()
    bridge, state = ScanBridge(LidarConfig()), new_state()
    bridge.T_base_lidar = np.array(log.mount)
    due: list[Record] = []
    times: list[int] = []
    for event in log.events(0.0):
        if isinstance(event, RawOdometry):
            moved = wheels.increment(event)
            due += [] if moved is None else [moved]
            continue
        due.append(bridge.scan(event))
        begin = time.process_time_ns()
        step(state, due, UNLIMITED)
        times.append(time.process_time_ns() - begin)
        due.clear()
        if len(times) == scans:
            break
    return 1e-6 * statistics.median(times)
