"""Motion consistency of odometry and lidar: compares their motion over a sliding window of the last seconds.

The lidar's motion is that of ``T_odom_base`` at scans whose match fixed every axis. The odometry's motion is the chain
of its increments alone, which the lidar never affects.
Where a match did not fix an axis, the pose took that axis from the odometry, and the comparison would be circular. Such
scans empty the window.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from estimator import Array, Odometry, se2

WINDOW_S: Final = 2.0
"""Window in s: long against stamp jitter, short against odometry drift."""
SHORTEST: Final = 0.5
"""Share of the window that has to be covered for a comparison."""
PART_M: Final = 0.2
FLOOR_M: Final = 0.08
PART_RAD: Final = 0.2
FLOOR_RAD: Final = 0.1
"""Permitted difference: a share of the motion (slip, scale) and a minimum (stamps, and odometry that rotates the robot
by itself). On the recorded drive through the Intel Research Lab, half of all windows differ by 0.03 rad, 1 % by 0.11.
"""


@dataclass(frozen=True, slots=True, eq=False)
class MotionComparison:
    """Motion over some ``seconds`` by ``laser`` and by ``wheels`` (odometry): T_then_now, (x, y, yaw) in m, m, rad."""

    seconds: float
    laser: Array
    wheels: Array

    @property
    def apart(self) -> tuple[float, float]:
        """Difference of the two motions, m and rad."""
        dx, dy, dyaw = se2.between(self.laser, self.wheels).tolist()
        return math.hypot(dx, dy), abs(dyaw)

    @property
    def agree(self) -> bool:
        """Whether slip and stamp errors explain the difference."""
        away_m, away_rad = self.apart
        way = max(math.hypot(*self.laser[:2].tolist()), math.hypot(*self.wheels[:2].tolist()))
        turned = max(abs(float(self.laser[2])), abs(float(self.wheels[2])))
        swing = FLOOR_M + PART_M * way + PART_RAD * turned * way
        return away_m <= swing and away_rad <= FLOOR_RAD + PART_RAD * turned


@dataclass(slots=True, eq=False)
class _Seen:
    """One lidar pose; ``wheels``: the odometry's pose at that instant, constant once it is computed."""

    t_mono: float
    T_odom_base: Array
    wheels: Array | None = None


class MotionConsistency:
    """Compares both motions; stores a few seconds of poses and nothing else."""

    def __init__(self) -> None:
        self._wheels: deque[tuple[float, Array]] = deque()
        self._laser: deque[_Seen] = deque()
        self._T_start_base = se2.identity()

    def restart(self) -> None:
        """Clear the window: the odometry has jumped, or an operator has set the pose."""
        self._wheels.clear()
        self._laser.clear()

    def on_odometry(self, record: Odometry) -> None:
        """Add one odometry increment."""
        if not self._wheels:
            self._wheels.append((record.t_begin, self._T_start_base))
        self._T_start_base = se2.compose(self._T_start_base, record.delta)
        self._wheels.append((record.t_end, self._T_start_base))
        while self._wheels[-1][0] - self._wheels[0][0] > 2.0 * WINDOW_S:
            self._wheels.popleft()

    def on_match(self, t_mono: float, T_odom_base: Array, complete: bool) -> None:
        """Add the lidar's pose at one scan; ``complete``: the match is good and fixed every axis."""
        if not complete:
            self._laser.clear()
            return
        self._laser.append(_Seen(t_mono, T_odom_base))
        while self._laser[-1].t_mono - self._laser[0].t_mono > 2.0 * WINDOW_S:
            self._laser.popleft()

    def agree(self) -> bool | None:
        """Whether both motions over the window agree; None while not available."""
        told = self.compared()
        return None if told is None else told.agree

    def compared(self) -> MotionComparison | None:
        """Both motions over the window; None while not available."""
        span = self._span()
        if span is None:
            return None
        old, new = span
        laser = se2.between(old.T_odom_base, new.T_odom_base)
        wheels = se2.between(self._wheels_at(old), self._wheels_at(new))
        return MotionComparison(new.t_mono - old.t_mono, laser, wheels)

    def _span(self) -> tuple[_Seen, _Seen] | None:
        """Oldest and newest lidar pose inside the window for which odometry is available."""
        if not self._wheels:
            return None
        first, last = self._wheels[0][0], self._wheels[-1][0]
        first = max(first, last - WINDOW_S)
        oldest = next((pose for pose in self._laser if first <= pose.t_mono <= last), None)
        newest = next((pose for pose in reversed(self._laser) if first <= pose.t_mono <= last), None)
        if oldest is None or newest is None or newest.t_mono - oldest.t_mono < SHORTEST * WINDOW_S:
            return None
        return oldest, newest

    def _wheels_at(self, seen: _Seen) -> Array:
        """Odometry pose at the instant of a lidar pose; interpolated once, while it is in the recent history."""
        if seen.wheels is None:
            seen.wheels = self._wheel_pose(seen.t_mono)
        return seen.wheels

    def _wheel_pose(self, t_mono: float) -> Array:
        """Odometry pose at an instant inside its history, at constant twist between two readings."""
        t_new, T_new = self._wheels[-1]
        for t_old, T_old in reversed(self._wheels):
            if t_old < t_mono:
                if t_new == t_mono:
                    break
                part = (t_mono - t_old) / (t_new - t_old)
                return se2.compose(T_old, se2.exp(part * se2.log(se2.between(T_old, T_new))))
            t_new, T_new = t_old, T_old
        return T_new
