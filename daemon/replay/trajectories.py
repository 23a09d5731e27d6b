"""Trajectories of a replay: poses as published, poses as finally optimised, and the statistics of a run."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from daemon.replay.results import Trajectory, written_stamp
from daemon.runtime.cycle_parts import CycleRecord
from estimator import Array, Loop, StepResult, se2

_FIELDS: Final = 12
_STAMP, _ANCHOR, _STATE = 0, 1, 11
_ONLINE, _ODOM, _ON_ANCHOR = slice(2, 5), slice(5, 8), slice(8, 11)


@dataclass(slots=True)
class Ledger:
    """Table with one row per pose, in the order of the log, and counters.

    A scan gives a row, and where scans are missing, each cycle in which light alone held the pose. A cycle that
    corrects the pose of the same instant replaces the row. A row has 96 bytes: a day at 40 Hz fits into memory.

    Attributes:
        cycles, keyframes, matched: counts. outcomes: number of matches by reason. states: number of snapshots by state.
        loops: each with the stamp of its scan. corrected_m, corrected_rad: largest correction by a match.
        jumps: of T_map_odom. dropped: scans that a later one replaced before a cycle consumed them.
    """

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
    _samples: int = 0
    _rows: array[float] = field(default_factory=lambda: array("d"))
    _settled: list[Array] = field(default_factory=list)

    def __len__(self) -> int:
        """Number of rows: cycles that gave a pose."""
        return len(self._rows) // _FIELDS

    def add(self, record: CycleRecord, stamp: float, t_mono: float) -> int | None:
        """Adds one cycle; returns the row of its pose, None without one.

        ``stamp``: the log's for the latest scan or block, s, whose time is ``t_mono``, s.
        """
        self.cycles += 1
        self.dropped += len(record.dropped)
        self.states[record.snapshot.state.name] += 1
        result, pose = record.result, record.snapshot.pose
        if result is None:
            return None
        self.jumps = result.jumps
        if record.limits is not None:
            self._count(result, stamp)
        lit = record.samples > self._samples and result.lights is not None and result.placed
        self._samples = record.samples
        if pose is None or not (record.scan is not None or lit):
            return None
        at = stamp + (result.t_mono - t_mono)
        odom, on_anchor = result.T_odom_base.tolist(), result.T_anchor_base.tolist()
        return self._put((at, result.anchor, *pose, *odom, *on_anchor, float(record.snapshot.state)))

    def _put(self, row: tuple[float, ...]) -> int:
        """Appends a row, or replaces the last one if that has the same stamp; returns its number."""
        if len(self) > self._fixed and written_stamp(self._rows[-_FIELDS]) == written_stamp(row[_STAMP]):
            del self._rows[-_FIELDS:]
        self._rows.extend(row)
        return len(self) - 1

    @property
    def _fixed(self) -> int:
        """Number of rows whose poses :meth:`settle` has fixed."""
        return sum(map(len, self._settled))

    def _count(self, result: StepResult, stamp: float) -> None:
        self.keyframes += result.keyframe >= 0
        if result.loop is not None:
            self.loops.append((stamp, result.loop))
        if result.match is not None:
            self.outcomes[result.match.reason.name] += 1
            self.matched += result.match.ok
            dx, dy, dyaw = result.match.correction.tolist()
            self.corrected_m = max(self.corrected_m, math.hypot(dx, dy))
            self.corrected_rad = max(self.corrected_rad, abs(dyaw))

    def settle(self, keyframes: dict[int, Array]) -> None:
        """Fixes every pose by the present position of its anchor keyframe.

        Called before the map is discarded and at the end of the log. A pose whose anchor is not among ``keyframes``
        stays as published.
        """
        rows = self._table()[self._fixed :]
        final = rows[:, _ONLINE].copy()
        for i, row in enumerate(rows):
            place = keyframes.get(int(row[_ANCHOR]))
            if place is not None:
                final[i] = se2.compose(place, row[_ON_ANCHOR])
        self._settled.append(final)

    def online(self) -> Trajectory:
        """Returns T_map_base of every scan as published, with the published state."""
        rows = self._table()
        return Trajectory(rows[:, _STAMP], rows[:, _ONLINE], rows[:, _STATE].astype(np.int64))

    def final(self) -> Trajectory:
        """Returns T_map_base of every scan as fixed by :meth:`settle`; as published if not fixed yet."""
        rows = self._table()
        settled = np.concatenate([*self._settled, np.empty((0, 3))])
        return Trajectory(rows[:, _STAMP], np.concatenate([settled, rows[len(settled) :, _ONLINE]]))

    def odom(self) -> Array:
        """Returns T_odom_base of every scan, (n, 3), in m, m, rad."""
        return self._table()[:, _ODOM]

    def largest_step(self) -> tuple[float, float, float]:
        """Returns the largest step of T_odom_base between two scans, m and rad, and the stamp after the one in m."""
        poses = self.odom()
        if len(poses) < 2:
            return 0.0, 0.0, 0.0
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        turns = np.abs(wrap(np.diff(poses[:, 2])))
        return float(steps.max()), float(turns.max()), float(self._table()[int(steps.argmax()) + 1, _STAMP])

    def way(self) -> tuple[float, float]:
        """Returns the path length of T_odom_base, m, and its total rotation, rad."""
        poses = self.odom()
        return (
            float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()),
            float(np.abs(wrap(np.diff(poses[:, 2]))).sum()),
        )

    def _table(self) -> Array:
        return np.array(self._rows, dtype=np.float64).reshape(-1, _FIELDS)


def wrap(angles: Array) -> Array:
    """Returns angles in rad, wrapped to -pi to pi."""
    return np.asarray(np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)
