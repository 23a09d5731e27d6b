"""What a replay keeps of every scan: poses as published, poses as they stand at the end, and the figures of a run."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from daemon.cycle import CycleRecord
from daemon.results import Trajectory
from estimator import se2
from estimator.records import Array
from estimator.result import Loop

Pose = tuple[float, float, float]


@dataclass(slots=True)
class Row:
    """One scan's outcome.

    Attributes:
        stamp: of the log, seconds, at the instant the pose is true for.
        online: T_map_base as published. odom: T_odom_base. anchor, T_anchor_base: as in `StepResult`.
        final: T_map_base once its anchor is gone, None while the anchor still says where it is.
    """

    stamp: float
    online: Pose
    odom: Pose
    anchor: int
    T_anchor_base: Array
    final: Pose | None = None


@dataclass(slots=True)
class Ledger:
    """Rows in the order of the log, and counts.

    Attributes:
        cycles, keyframes, matched: counts. outcomes: how often each reason of a match came. states: of the snapshot.
        loops: each with the stamp of its scan. corrected_m, corrected_rad: largest correction by a match.
        jumps: of T_map_odom. dropped: scans that a later one replaced before a cycle took them.
    """

    rows: list[Row] = field(default_factory=list)
    cycles: int = 0
    keyframes: int = 0
    matched: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    loops: list[tuple[float, Loop]] = field(default_factory=list)
    corrected_m: float = 0.0
    corrected_rad: float = 0.0
    jumps: int = 0
    dropped: int = 0

    def take(self, record: CycleRecord, stamp: float, t_mono: float) -> None:
        """Take in one cycle; ``stamp`` is the log's for the latest scan, which was measured at ``t_mono``."""
        self.cycles += 1
        self.dropped += len(record.dropped)
        self.states[record.snapshot.state.name] += 1
        result, pose = record.result, record.snapshot.pose
        if result is None:
            return
        self.jumps = result.jumps
        if record.limits is not None:
            self.keyframes += result.keyframe >= 0
            if result.loop is not None:
                self.loops.append((stamp, result.loop))
        if record.scan is None or pose is None:
            return
        if result.match is not None:
            self.outcomes[result.match.reason.name] += 1
            self.matched += result.match.ok
            dx, dy, dyaw = result.match.correction.tolist()
            self.corrected_m = max(self.corrected_m, math.hypot(dx, dy))
            self.corrected_rad = max(self.corrected_rad, abs(dyaw))
        x, y, yaw = result.T_odom_base.tolist()
        at = stamp + (result.t_mono - t_mono)
        self.rows.append(Row(at, pose, (x, y, yaw), result.anchor, result.T_anchor_base))

    def settle(self, keyframes: dict[int, Array]) -> None:
        """Fix every pose by its anchor's present place: the map is about to be thrown away, or the log has ended."""
        for row in self.rows:
            if row.final is None and row.anchor in keyframes:
                x, y, yaw = se2.compose(keyframes[row.anchor], row.T_anchor_base).tolist()
                row.final = (x, y, yaw)

    def online(self) -> Trajectory:
        """T_map_base of every scan as it was published."""
        return self._trajectory([row.online for row in self.rows])

    def final(self) -> Trajectory:
        """T_map_base of every scan by what is known at the end; as published where its anchor is not known."""
        return self._trajectory([row.final or row.online for row in self.rows])

    def largest_step(self) -> tuple[float, float, float]:
        """Largest step of T_odom_base between two scans: metres, radians, and the stamp after the one in metres."""
        poses = self._odom()
        if len(poses) < 2:
            return 0.0, 0.0, 0.0
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        turns = np.abs(wrap(np.diff(poses[:, 2])))
        return float(steps.max()), float(turns.max()), self.rows[int(steps.argmax()) + 1].stamp

    def way(self) -> tuple[float, float]:
        """Length of T_odom_base's path in metres, and all it has turned in radians."""
        poses = self._odom()
        return (
            float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()),
            float(np.abs(wrap(np.diff(poses[:, 2]))).sum()),
        )

    def _odom(self) -> Array:
        return np.array([row.odom for row in self.rows], dtype=np.float64).reshape(-1, 3)

    def _trajectory(self, poses: list[Pose]) -> Trajectory:
        stamps = np.array([row.stamp for row in self.rows], dtype=np.float64)
        return Trajectory(stamps, np.array(poses, dtype=np.float64).reshape(-1, 3))


def wrap(angles: Array) -> Array:
    """Angles in rad, brought into -pi to pi."""
    return np.asarray(np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)
