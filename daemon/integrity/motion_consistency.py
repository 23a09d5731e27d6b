"""Consistency of odometry and laser: compares their motion over a sliding window of the last seconds.

The laser's witness is ``T_odom_base`` at scans whose match fixed every axis; the wheels' witness is the bare chain of
odometry increments, which the laser never touches. Where a match did not fix an axis, the pose took that axis from the
wheels, and agreement would be an echo: such scans empty the window.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from estimator import Array, Odometry, se2

WINDOW_S: Final = 2.0
"""Long against stamp jitter, short against odometry drift."""
SHORTEST: Final = 0.5
"""Part of the window that has to be covered before anything is said."""
PART_M: Final = 0.2
FLOOR_M: Final = 0.08
PART_RAD: Final = 0.2
FLOOR_RAD: Final = 0.1
"""Allowed disagreement: a part of the motion (slip, scale) and a floor (stamps, and wheels that turn the robot by
itself: on the recorded drive through the Intel Research Lab half of all windows are 0.03 rad apart, 1 % 0.11)."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionComparison:
    """The motion over some ``seconds`` as the ``laser`` and as the ``wheels`` tell it: T_then_now, (x, y, yaw)."""

    seconds: float
    laser: Array
    wheels: Array

    @property
    def apart(self) -> tuple[float, float]:
        """By how much they differ, m and rad."""
        dx, dy, dyaw = se2.between(self.laser, self.wheels).tolist()
        return math.hypot(dx, dy), abs(dyaw)

    @property
    def agree(self) -> bool:
        """Whether that is no more than slip and stamps explain."""
        away_m, away_rad = self.apart
        way = max(math.hypot(*self.laser[:2].tolist()), math.hypot(*self.wheels[:2].tolist()))
        turned = max(abs(float(self.laser[2])), abs(float(self.wheels[2])))
        swing = FLOOR_M + PART_M * way + PART_RAD * turned * way
        return away_m <= swing and away_rad <= FLOOR_RAD + PART_RAD * turned


@dataclass(slots=True, eq=False)
class _Seen:
    """A pose of the laser; the ``wheels``' own at that instant once it was asked for, which nothing changes later."""

    t_mono: float
    T_odom_base: Array
    wheels: Array | None = None


class MotionConsistency:
    """Compares both motions; holds a few seconds of poses and nothing else."""

    def __init__(self) -> None:
        self._wheels: deque[tuple[float, Array]] = deque()
        self._laser: deque[_Seen] = deque()
        self._T_start_base = se2.identity()

    def restart(self) -> None:
        """Forget the window: the odometry has jumped, or a person has moved the pose."""
        self._wheels.clear()
        self._laser.clear()

    def on_odometry(self, record: Odometry) -> None:
        """Take in one increment of the wheels."""
        if not self._wheels:
            self._wheels.append((record.t_begin, self._T_start_base))
        self._T_start_base = se2.compose(self._T_start_base, record.delta)
        self._wheels.append((record.t_end, self._T_start_base))
        while self._wheels[-1][0] - self._wheels[0][0] > 2.0 * WINDOW_S:
            self._wheels.popleft()

    def on_match(self, t_mono: float, T_odom_base: Array, complete: bool) -> None:
        """Take in the laser's pose at one scan; ``complete``: the match is good and fixed every axis."""
        if not complete:
            self._laser.clear()
            return
        self._laser.append(_Seen(t_mono, T_odom_base))
        while self._laser[-1].t_mono - self._laser[0].t_mono > 2.0 * WINDOW_S:
            self._laser.popleft()

    def agree(self) -> bool | None:
        """Whether both told the same motion over the window; None while that cannot be said."""
        told = self.compared()
        return None if told is None else told.agree

    def compared(self) -> MotionComparison | None:
        """What both told over the window; None while that cannot be said."""
        span = self._span()
        if span is None:
            return None
        old, new = span
        laser = se2.between(old.T_odom_base, new.T_odom_base)
        wheels = se2.between(self._wheels_at(old), self._wheels_at(new))
        return MotionComparison(new.t_mono - old.t_mono, laser, wheels)

    def _span(self) -> tuple[_Seen, _Seen] | None:
        """Oldest and newest laser pose inside the window for which the wheels have spoken too."""
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
        """The wheels' pose at the instant of a laser pose; looked up once, while it is among the newest."""
        if seen.wheels is None:
            seen.wheels = self._wheel_pose(seen.t_mono)
        return seen.wheels

    def _wheel_pose(self, t_mono: float) -> Array:
        """The wheels' pose at an instant inside their history, at constant twist between two readings."""
        t_new, T_new = self._wheels[-1]
        for t_old, T_old in reversed(self._wheels):
            if t_old < t_mono:
                if t_new == t_mono:
                    break
                part = (t_mono - t_old) / (t_new - t_old)
                return se2.compose(T_old, se2.exp(part * se2.log(se2.between(T_old, T_new))))
            t_new, T_new = t_old, T_old
        return T_new
