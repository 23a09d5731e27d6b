"""Whether the heading that light tells has come to rest.

The `lights` filter finds the heading from how strengths change along the way. Lamps that go out one after the other, or
hang in one row, can lead it astray by far more than it reckons with, and the pose, which takes a part of each epoch,
goes along for a while and comes to believe it. What gives it away is that it does not stay: against the laser's own
heading, which it should stand still, it swings there and back within a metre or two.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from estimator.numerics import se2

LOOK_M: Final = 2.0
"""Way over which it must have stood still."""
SWING_RAD: Final = 0.15
"""Swing within that way from which on it has not: of 150 starts one of thirty had more, and two of these five were
wrong by 7 deg."""
STEP_M: Final = 0.1
"""Way of which only least and most are kept: a robot at rest has twenty epochs a second."""


@dataclass(slots=True, eq=False)
class Swing:
    """The heading by light in the odom frame over the last stretch of way; start with ``Swing()``.

    Attributes:
        seen: per step of way: where it began (m), least and most of the heading (rad, unwrapped).
    """

    seen: deque[tuple[float, float, float]] = field(default_factory=deque)

    def take(self, way: float, yaw_map_odom: float) -> None:
        """Take in what an epoch says of the odom frame's heading in the survey (rad), after so much way (m)."""
        while self.seen and way - self.seen[0][0] > LOOK_M:
            self.seen.popleft()
        if not self.seen:
            self.seen.append((way, yaw_map_odom, yaw_map_odom))
            return
        begun, least, most = self.seen[-1]
        yaw = least + se2.wrap(yaw_map_odom - least)
        if way - begun > STEP_M:
            self.seen.append((way, yaw, yaw))
        else:
            self.seen[-1] = begun, min(least, yaw), max(most, yaw)

    def forget(self) -> None:
        """The place is another one."""
        self.seen.clear()

    @property
    def rests(self) -> bool:
        """Whether it has stayed within `SWING_RAD`."""
        if not self.seen:
            return True
        return max(most for _, _, most in self.seen) - min(least for _, least, _ in self.seen) <= SWING_RAD
