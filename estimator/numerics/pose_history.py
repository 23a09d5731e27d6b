"""Buffer of recent poses, interpolated at constant twist."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from estimator.numerics import se2
from estimator.numerics.arrays import Array

Stamped = tuple[float, Array]
"""An instant (s) and the pose (x, y, yaw) at it."""


@dataclass(slots=True, eq=False)
class PoseHistory:
    """Poses in order of arrival, with non-decreasing instants.

    Attributes:
        span_s: length of the history, s.
        first: which of several poses of one instant ends the interval before that instant. True: the first, as where
            odometry replaces a prediction over the same interval. False: the latest.
        poses: oldest first.
    """

    span_s: float
    first: bool
    poses: deque[Stamped] = field(default_factory=deque)

    def add(self, t_mono: float, T: Array) -> None:
        """Append a pose and drop those older than the span."""
        self.poses.append((t_mono, T))
        while t_mono - self.poses[0][0] > self.span_s:
            self.poses.popleft()

    def at(self, t_mono: float, after: Stamped) -> Array:
        """Pose at an instant, interpolated up to ``after``, a known later pose.

        Before the oldest pose it returns the oldest.
        """
        for t, T in reversed(self.poses):
            if t <= t_mono and (self.first or t_mono < after[0]):
                span = after[0] - t
                share = 0.0 if span <= 0.0 else min(1.0, (t_mono - t) / span)
                return se2.compose(T, se2.fraction(se2.between(T, after[1]), share))
            if self.first or t < after[0]:
                after = t, T
        return after[1]
