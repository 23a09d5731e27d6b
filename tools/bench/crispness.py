"""Crispness of the map from real logs, ours against scan-to-scan matching; needs ``LUMILOOP_DATA``.

Every ``EVERY``-th scan's points are placed by the trajectory. Each of them counts with the distance to the nearest
point of all such scans that were taken more than ``APART_S`` before or after its own, so that a wall which drifts apart
in time shows, and a scan cannot vouch for itself. A point with nothing within ``FAR_M`` counts as so far: none is left
out, and a trajectory gains nothing from points that it spoils. The mean over all points is the crispness, in mm; less
is better.

Ours is T_odom_base as it was published: no loop closure, no hindsight. The peer matches every scan with the one before
by point-to-line ICP on scipy's cKDTree, in full (`peers.kdtree`, normals from few and from many neighbours: the better
one of each log counts), from the wheels' motion where there are wheels, else from its own last motion. Both take each
beam at its own instant.
"""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from daemon.config.schema import Config
from daemon.devices.conversion import ScanBridge
from daemon.replay import convert
from daemon.replay.log_replay import Outcome, replay
from daemon.replay.sources import open_log
from estimator.measurements import Array, Scan
from estimator.numerics import se2
from estimator.paper import LUMILOOP
from estimator.scan_matching.deskew import points_of
from hal.lidar import RawScan
from hal.odometry import RawOdometry
from tools.bench.support.peers import MANY, NEIGHBOURS, Match, kdtree
from tools.ci.figures import Figure, bounded

COMMAND: Final = "LUMILOOP_DATA=... python -m tools.bench crispness"
LOGS: Final = {"exp1": "urg04lx/exp1.dat.gz", "exp2": "urg04lx/exp2.dat.gz", "utm": "utm30lx/scans.npz"}
EVERY: Final = 5
APART_S: Final = 1.0
FAR_M: Final = 0.3
ENOUGH: Final = 20
"""Fewer points are not matched by the peer: it goes on by its start."""
LONGEST_S: Final = 0.5
"""Two scans farther apart in time say nothing about the motion within one."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A log's scans, instants of their ends (n,), wheel poses (n, 3) then (None without wheels), our poses (n, 3)."""

    scans: list[Scan]
    t_end: Array
    wheels: Array | None
    ours: Array

    def clouds(self, poses: Array) -> list[Array]:
        """(m, 2) points of each scan in its base frame, every beam from where the robot was along ``poses`` then."""
        made = []
        for k, scan in enumerate(self.scans):
            move = se2.between(poses[k - 1], poses[k]) if k else se2.identity()
            made.append(self.cloud(k, move, scan))
        return made

    def cloud(self, k: int, move: Array, scan: Scan) -> Array:
        """The same for scan ``k``, the robot having moved by ``move`` since the one before."""
        dt = float(self.t_end[k] - self.t_end[k - 1]) if k else 0.0
        share = (scan.t_end - scan.t_begin) / dt if 0.0 < dt < LONGEST_S else 0.0
        return points_of(scan, se2.exp(share * se2.log(move)), 80.0, 0.0).xy


def run() -> list[Figure]:
    """All logs.

    Raises:
        RuntimeError: LUMILOOP_DATA does not name the folder of real logs.
    """
    data = os.environ.get("LUMILOOP_DATA")
    if not data:
        raise RuntimeError("LUMILOOP_DATA does not name the folder of real logs (see docs/data.md)")
    figures = []
    for name, source in LOGS.items():
        drive = load(Path(data) / source)
        ours = crispness(drive, drive.ours)
        theirs = best_peer(drive)
        text = f"{name}: mean nearest distance, "
        figures += [
            bounded(f"{text}ours", 1e3 * ours, "mm", f"<= {1e3 * theirs:.2f}", COMMAND),
            Figure(f"{text}scan to scan by cKDTree", 1e3 * theirs, "mm", command=COMMAND),
        ]
    return figures


def load(source: Path, method: str = LUMILOOP) -> Drive:
    """Convert a log, replay it by a method, and keep what both ways need."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "scans.log"
        convert.convert(source, log)
        outcome = replay(open_log(log), Config(), method=method)
        return drive_of(outcome, log)


def drive_of(outcome: Outcome, log: Path) -> Drive:
    """The scans of a log beside the poses of its replay, one each."""
    bridge = ScanBridge(outcome.config.lidar)
    scans, readings = [], []
    for event in open_log(log).events():
        if isinstance(event, RawScan):
            scans.append(bridge.scan(event))
        elif isinstance(event, RawOdometry):
            readings.append((event.t_mono, event.x, event.y, event.yaw))
    poses = outcome.rerun.ledger.odom()
    if len(scans) != len(poses):
        raise RuntimeError(f"{log} has {len(scans)} scans, but {len(poses)} have a pose")
    t_end = np.array([scan.t_end for scan in scans])
    return Drive(scans, t_end, wheels_at(np.array(readings), t_end) if readings else None, poses)


def wheels_at(readings: Array, t: Array) -> Array:
    """Poses (n, 3) by the wheels at ``t`` (n,), between readings (m, 4) of instant and pose."""
    yaw = np.unwrap(readings[:, 3])
    return np.column_stack([np.interp(t, readings[:, 0], row) for row in (readings[:, 1], readings[:, 2], yaw)])


def best_peer(drive: Drive) -> float:
    """Crispness of the peer, at the better of its two settings."""
    return min(crispness(drive, scan_to_scan(drive, kdtree(count))) for count in (NEIGHBOURS, MANY))


def scan_to_scan(drive: Drive, match: Match) -> Array:
    """Poses (n, 3) of a peer."""
    poses, move = np.zeros((len(drive.scans), 3)), se2.identity()
    before = drive.cloud(0, move, drive.scans[0])
    for k in range(1, len(drive.scans)):
        if drive.wheels is not None:
            move = se2.between(drive.wheels[k - 1], drive.wheels[k])
        points = drive.cloud(k, move, drive.scans[k])
        if min(len(points), len(before)) >= ENOUGH:
            move = match(before, points, move)
        poses[k] = se2.compose(poses[k - 1], move)
        before = points
    return poses


def crispness(drive: Drive, poses: Array) -> float:
    """Mean nearest distance, m: see the head of this file."""
    clouds = drive.clouds(poses)
    kept = range(0, len(clouds), EVERY)
    placed = np.concatenate([se2.apply(poses[k], clouds[k]) for k in kept])
    times = np.concatenate([np.full(len(clouds[k]), drive.t_end[k]) for k in kept])
    return float(nearest_of_other_times(placed, times).mean())


def nearest_of_other_times(points: Array, times: Array) -> Array:
    """For each point (n, 2) the distance to the nearest of another time, at most ``FAR_M``; ``times`` ascend."""
    found = np.full(len(points), FAR_M)
    for t in np.unique(times):
        here = np.flatnonzero(times == t)
        others = points[np.abs(times - t) > APART_S]
        if len(others):
            distance, _ = cKDTree(others).query(points[here], distance_upper_bound=FAR_M)
            found[here] = np.minimum(distance, FAR_M)
    return found
