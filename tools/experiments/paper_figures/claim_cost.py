"""What a match costs: iterations, look-ups, and points compared, told again from its trace."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from estimator.numerics import se2
from estimator.numerics.arrays import Ints
from estimator.scan_matching import icp
from estimator.scan_matching.nearest_neighbour import nearest_all
from tools.experiments.support.trajectory import Array

Axis = tuple[Array, Ints, Array]
"""Rows, start and rays of the reference."""


@dataclass(frozen=True, slots=True)
class Effort:
    """Of one match. iterations; sought: points looked up; visits: reference points compared with one."""

    iterations: int
    sought: int
    visits: int

    def __add__(self, other: Effort) -> Effort:
        return Effort(self.iterations + other.iterations, self.sought + other.sought, self.visits + other.visits)


def effort_of(points: Array, axis: Axis, trace: Array, keeps: bool) -> Effort:
    """The effort of an attempt, told again from its trace.

    Args:
        points: (n, 2 or more) as they were matched.
        axis: they were matched on.
        trace: of the attempt.
        keeps: whether the matcher keeps the partner of a point that has not left its safe radius.
    """
    safe = np.zeros((len(points), 3))
    visits = 0
    for row in trace:
        some = np.arange(0, len(points), int(row[icp.STRIDE]))
        at = se2.apply(row[icp.AT_X : icp.AT_YAW + 1], points[some, :2])
        left = np.sum((at - safe[some, :2]) ** 2, axis=1) >= safe[some, 2]
        count, radius2 = look_up(axis, at[left], float(row[icp.GATE]))
        visits += count
        if keeps:
            safe[some[left]] = np.column_stack((at[left], radius2))
    return Effort(len(trace), int(trace[:, icp.SOUGHT].sum()), visits)


def look_up(axis: Axis, queries: Array, gate: float) -> tuple[int, Array]:
    """Search for queries (m, 2) relative to the centre: reference points compared, and squared safe radii (m,)."""
    rows, start, rays = axis
    n = len(queries)
    row, d2, e2, visits = np.empty(n, np.int64), np.empty(n), np.empty(n), np.empty(n, np.int64)
    nearest_all(rows, start, rays, np.ascontiguousarray(queries), gate * gate, (row, d2, e2, visits))
    radius2 = np.where(row >= 0, 0.25 * (np.sqrt(e2) - np.sqrt(d2)) ** 2, 0.0)
    return int(visits.sum()), radius2


def timed(works: Sequence[Callable[[], object]], times: int = 3) -> list[float]:
    """Milliseconds of processor time of each, the least of some runs, taken in turn so that all meet one machine."""
    best = [np.inf] * len(works)
    for _ in range(times):
        for k, work in enumerate(works):
            begin = time.thread_time_ns()
            work()
            best[k] = min(best[k], 1e-6 * (time.thread_time_ns() - begin))
    return best
