"""Motion of the last two seconds, to match a late scan at the pose of its own instant.

The line or the computer can delay a scan, while other records have moved the pose on. A match at the present pose would
pull it back by the path since. So the pose moves back along the history (:func:`go_back`). The scan is matched and
fused there, and the pose is propagated to the present again (:func:`come_again`).
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
"""Delay of a scan's end behind the pose, s, from which it is late: stamps of different devices vary by that much."""
KEPT_S = 2.0
"""Length of the history, s: an older scan is not matched."""
ANOTHER_CLOCK_S = 10.0
"""Delay, s, above which the scan's clock was set back, or the pose was once predicted to a wrong instant.

Such a scan is matched at the present pose, the only one available.
"""
STRETCH_S = 0.02
"""Motions are merged up to this length, s; readings may come a thousand times a second."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A motion ``delta`` over ``[t_begin, t_end]``, in the base frame at its begin, with its variance (x, y, yaw).

    Between two of them the pose is constant.
    """

    t_begin: float
    t_end: float
    delta: Array
    variance: Array


@dataclass(slots=True, eq=False)
class Trail:
    """Motion of the last :data:`KEPT_S` seconds, in order of time; complete from ``t_first`` on."""

    t_first: float = math.inf
    stretches: deque[Stretch] = field(default_factory=deque)

    def forget(self, t_first: float) -> None:
        """Clear the history; it begins at ``t_first``."""
        self.stretches.clear()
        self.t_first = t_first

    def add(self, t_begin: float, t_end: float, delta: Array, variance: Array) -> None:
        """Append a motion, and remove what is too old."""
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
        """Remove the motion after an instant, which a better measurement replaces."""
        before: Stretch | None = None
        while self.stretches and self.stretches[-1].t_end > t_mono:
            last = self.stretches.pop()
            if last.t_begin < t_mono:
                before = _part(last, last.t_begin, t_mono)
        if before is not None:
            self.stretches.append(before)

    def since(self, t_mono: float) -> list[Stretch] | None:
        """The motions after an instant, None where they are no longer available."""
        if t_mono < self.t_first:
            return None
        found: list[Stretch] = []
        for stretch in reversed(self.stretches):
            if stretch.t_end <= t_mono:
                break
            found.append(stretch if stretch.t_begin >= t_mono else _part(stretch, t_mono, stretch.t_end))
        return found[::-1]


def _part(stretch: Stretch, t_begin: float, t_end: float) -> Stretch:
    """The part of a motion within ``[t_begin, t_end]``, at constant twist."""
    share = (t_end - t_begin) / (stretch.t_end - stretch.t_begin)
    return Stretch(t_begin, t_end, se2.fraction(stretch.delta, share), stretch.variance * share)


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """Motion between a late scan and the present.

    Attributes:
        t_mono: the present instant.
        delta: motion since the scan, in the base frame then.
        Q: 3x3 covariance that it has added, in the axes of that frame, about the present position.
        shared: 3x3 covariance of that addition with the error of the survey alignment, likewise.
        known: whether ``Q`` was a part of the pose's covariance, and has been subtracted from it.
        velocity, velocity_variance: at the present instant.
    """

    t_mono: float
    delta: Array
    Q: Array
    shared: Array
    known: bool
    velocity: Array
    velocity_variance: Array


def made(stretches: list[Stretch]) -> tuple[Array, Array]:
    """Motion over all segments and its covariance (3, 3), both in the base frame before the first."""
    delta, Q = se2.identity(), np.zeros((3, 3))
    for stretch in stretches:
        R = se2.rotation(delta[2] + 0.5 * stretch.delta[2])
        Q = se2.carry(delta, stretch.delta, Q) + (R * stretch.variance) @ R.T
        delta = se2.compose(delta, stretch.delta)
    return delta, Q


def turned(Q: Array, yaw: float) -> Array:
    """A covariance in axes rotated by ``yaw`` from its own."""
    R = se2.rotation(yaw)
    return np.asarray(R @ Q @ R.T)


def positive(P: Array) -> bool:
    """Whether a 3x3 covariance is positive definite."""
    return bool(P[0, 0] > 0.0 and P[0, 0] * P[1, 1] > P[0, 1] * P[1, 0] and det3(P) > 0.0)
