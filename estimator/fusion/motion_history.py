"""The way of the last two seconds, so that a scan that comes late is matched where the robot was when it was true.

A scan is late when the line or the computer has held it up: what else has arrived has carried the pose on meanwhile.
Matched at the present pose it would drag that back by the way driven since. So the pose is taken back along the trail
(:func:`go_back`), the scan is matched, fused and kept there, and the pose is carried on again (:func:`come_again`).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import det3

LATE_S = 0.05
"""Age of a scan's end, against the pose, from which on it is matched where the robot was then: stamps of different
devices are no more even than that."""
KEPT_S = 2.0
"""How far back the way is known: a scan that is older is not matched."""
ANOTHER_CLOCK_S = 10.0
"""No scan is held up for so long: its clock has been set back, or the pose has once been carried to a wrong instant. It
is matched at the present pose, which is all that is known."""
STRETCH_S = 0.02
"""Motions are put together up to this length; readings may come a thousand times a second."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A motion ``delta`` made over ``[t_begin, t_end]``, in the base frame at its begin, with its variance (x, y, yaw).

    Between two stretches the pose has stood.
    """

    t_begin: float
    t_end: float
    delta: Array
    variance: Array


@dataclass(slots=True, eq=False)
class Trail:
    """Stretches of the last :data:`KEPT_S` seconds, in order of time; t_first: from when on none is missing."""

    t_first: float = math.inf
    stretches: deque[Stretch] = field(default_factory=deque)

    def forget(self, t_first: float) -> None:
        """Nobody knows what was before."""
        self.stretches.clear()
        self.t_first = t_first

    def add(self, t_begin: float, t_end: float, delta: Array, variance: Array) -> None:
        """Append a motion, and let go of what is too old."""
        if not (math.isfinite(t_begin) and t_end > t_begin):
            return
        self.t_first = min(self.t_first, t_begin)
        last = self.stretches[-1] if self.stretches else None
        if last is not None and t_begin == last.t_end and t_end - last.t_begin <= STRETCH_S:
            self.stretches.pop()
            t_begin, delta, variance = last.t_begin, se2.compose(last.delta, delta), last.variance + variance
        self.stretches.append(Stretch(t_begin, t_end, delta, variance))
        while self.stretches[0].t_end < t_end - KEPT_S:
            self.t_first = self.stretches.popleft().t_end

    def take_back(self, t_mono: float) -> None:
        """Drop what was made after an instant: somebody knows it better."""
        before: Stretch | None = None
        while self.stretches and self.stretches[-1].t_end > t_mono:
            last = self.stretches.pop()
            if last.t_begin < t_mono:
                before = _part(last, last.t_begin, t_mono)
        if before is not None:
            self.stretches.append(before)

    def since(self, t_mono: float) -> list[Stretch] | None:
        """What was made after an instant, None where that is not known any more."""
        if t_mono < self.t_first:
            return None
        found: list[Stretch] = []
        for stretch in reversed(self.stretches):
            if stretch.t_end <= t_mono:
                break
            found.append(stretch if stretch.t_begin >= t_mono else _part(stretch, t_mono, stretch.t_end))
        return found[::-1]


def _part(stretch: Stretch, t_begin: float, t_end: float) -> Stretch:
    """The part of a stretch that lies within ``[t_begin, t_end]``, at constant twist."""
    share = (t_end - t_begin) / (stretch.t_end - stretch.t_begin)
    return Stretch(t_begin, t_end, se2.fraction(stretch.delta, share), stretch.variance * share)


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """What lies between a late scan and now.

    Attributes:
        t_mono: now. delta: motion since, in the base frame of then. Q: 3x3 covariance of what it has added, in the axes
            of that frame, about the place of now.
        shared: 3x3, of what it has added with the error of the tie, likewise.
        known: whether ``Q`` was a part of the pose's covariance, and has been taken out of it.
        velocity, velocity_variance: as known now.
    """

    t_mono: float
    delta: Array
    Q: Array
    shared: Array
    known: bool
    velocity: Array
    velocity_variance: Array


def made(stretches: list[Stretch]) -> tuple[Array, Array]:
    """Motion over all stretches and its covariance (3, 3), both in the base frame before the first."""
    delta, Q = se2.identity(), np.zeros((3, 3))
    for stretch in stretches:
        R = se2.rotation(delta[2] + 0.5 * stretch.delta[2])
        Q = se2.carry(delta, stretch.delta, Q) + (R * stretch.variance) @ R.T
        delta = se2.compose(delta, stretch.delta)
    return delta, Q


def turned(Q: Array, yaw: float) -> Array:
    """A covariance in axes that are turned by ``yaw`` against its own."""
    R = se2.rotation(yaw)
    return np.asarray(R @ Q @ R.T)


def positive(P: Array) -> bool:
    """Whether a 3x3 covariance leaves no direction without an error."""
    return bool(P[0, 0] > 0.0 and P[0, 0] * P[1, 1] > P[0, 1] * P[1, 0] and det3(P) > 0.0)
