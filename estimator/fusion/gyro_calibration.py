"""Online calibration of the gyro's scale: its turn rates against those of the matches.

A gyro with a wrong unit, sign or axis measures a multiple of the true turn rate. The factor is the slope of a
regression of its rates on those of the matches, over intervals between two matches. The intercept is its bias. A gyro
with a large error of the factor is named and not used: its small noise would outweigh every other sensor.

Two other causes make both rates differ. A time offset adds an error by the change of the rate. One false match, or a
lidar mount that is knocked, turns the matches in a single interval: several intervals have to agree.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from estimator.fusion.motion_history import KEPT_S
from estimator.measurements import Imu
from estimator.numerics import se2
from estimator.numerics.arrays import Array

SPAN_S: Final = 0.5
"""Shortest interval (s): noise of two matches, 3 mrad, is then far below :data:`TURNING`, however fast the lidar."""
MEMORY, FEWEST = 16, 3.0
"""Intervals that the estimate remembers, and the fewest with a turn, 1.5 s of it, before an error is named."""
TURNING: Final = 0.05
"""Least deviation (rad/s) of the true turn rate: a robot that rocks by half a degree has less."""
LARGE, SURE = 0.2, 3.0
"""Error of the factor that is large, and sigmas by which it must exceed that. Sound gyros are right to 3 %."""
OFFSET_S: Final = 0.1
"""Largest time offset (s) between gyro and lidar that may pass for an error of the factor."""
FASTEST: Final = 10.0
"""Turn rate (rad/s) that no indoor robot reaches; readings in degrees exceed it from 0.2 rad/s on."""
COVERED: Final = 0.3
"""Largest share of an interval that the readings may leave out, or exceed."""


@dataclass(slots=True, eq=False)
class GyroCalibration:
    """State of the calibration.

    Attributes:
        readings: begin and end (s), and turn (rad), of readings that no interval has used.
        matches: instant (s) and heading (rad) of matches after the latest reading.
        begun: those of the match that began the interval, None before the first.
        rate: turn rate of the matches in the previous interval, rad/s.
        count: number of intervals.
        mean, square: mean (2,) and covariance (2, 2) of the rates (gyro, matches), rad/s.
        fourth: mean fourth power of the matches' deviation. changed: mean square of their change per second.
        told: factor of the readings over the true turn, None while it is about 1 or unknown.
    """

    readings: deque[tuple[float, float, float]] = field(default_factory=deque)
    matches: deque[tuple[float, float]] = field(default_factory=deque)
    begun: tuple[float, float] | None = None
    rate: float | None = None
    count: int = 0
    mean: Array = field(default_factory=lambda: np.zeros(2))
    square: Array = field(default_factory=lambda: np.zeros((2, 2)))
    fourth: float = 0.0
    changed: float = 0.0
    told: float | None = None

    def restart(self) -> None:
        """Begin a new interval: the heading of the base has changed without a turn."""
        self.matches.clear()
        self.begun = self.rate = None


def usable(gyro: GyroCalibration, record: Imu) -> bool:
    """Register a reading; returns whether it may be used."""
    dt = record.t_end - record.t_begin
    if dt > 0.0 and math.isfinite(record.dyaw) and math.isfinite(dt):
        if gyro.readings and record.t_begin < gyro.readings[-1][0]:  # its clock was set back
            gyro.readings.clear()
        gyro.readings.append((record.t_begin, record.t_end, record.dyaw))
        while gyro.readings[0][1] < record.t_end - KEPT_S:
            gyro.readings.popleft()
        while gyro.matches and gyro.matches[0][0] <= record.t_end:
            take(gyro, *gyro.matches.popleft())
    return gyro.told is None and not abs(record.dyaw) > FASTEST * dt


def on_match(gyro: GyroCalibration, t_mono: float, yaw: float) -> None:
    """Take the heading (rad) of a match at its instant (s); it waits for the readings until then."""
    if not gyro.readings:
        return
    if t_mono <= gyro.readings[-1][1]:
        take(gyro, t_mono, yaw)
        return
    gyro.matches.append((t_mono, yaw))
    while gyro.matches[0][0] < t_mono - KEPT_S:
        gyro.matches.popleft()


def take(gyro: GyroCalibration, t_mono: float, yaw: float) -> None:
    """End an interval at a match that is far enough from its begin, and begin the next one."""
    if gyro.begun is None or not 0.0 <= t_mono - gyro.begun[0] < KEPT_S:
        gyro.begun, gyro.rate = (t_mono, yaw), None
        return
    t_begin, before = gyro.begun
    dt = t_mono - t_begin
    if dt < SPAN_S:
        return
    turned, span = summed(gyro, t_begin, t_mono)
    gyro.begun, last = (t_mono, yaw), gyro.rate
    gyro.rate = se2.wrap(yaw - before) / dt
    if abs(span - dt) < COVERED * dt and math.isfinite(turned):
        learn(gyro, turned / span, gyro.rate, 0.0 if last is None else (gyro.rate - last) / dt)


def summed(gyro: GyroCalibration, t_begin: float, t_end: float) -> tuple[float, float]:
    """Turn (rad) and duration (s) of the readings within an interval; removes those before its end."""
    turned = span = 0.0
    for begin, end, turn in gyro.readings:
        inside = min(end, t_end) - max(begin, t_begin)
        if inside > 0.0:
            turned += turn * inside / (end - begin)
            span += inside
    while gyro.readings and gyro.readings[0][1] <= t_end:
        gyro.readings.popleft()
    return turned, span


def learn(gyro: GyroCalibration, rate: float, true: float, change: float) -> None:
    """Update the regression by the rates (rad/s) of an interval, and the change of the true one, rad/s^2."""
    gyro.count += 1
    share = max(1.0 / gyro.count, 1.0 / MEMORY)
    off = np.array((rate, true)) - gyro.mean
    gyro.mean = gyro.mean + share * off
    gyro.square = (1.0 - share) * (gyro.square + share * np.outer(off, off))
    gyro.fourth = (1.0 - share) * (gyro.fourth + share * float(off[1]) ** 4)
    gyro.changed += share * (change * change - gyro.changed)
    gyro.told = judged(gyro)


def judged(gyro: GyroCalibration) -> float | None:
    """The factor, where it is large; one that was named ends when it is no longer."""
    (gg, gm), (_, mm) = gyro.square.tolist()
    if mm < TURNING**2:
        return gyro.told
    turning = min(gyro.count, MEMORY) * mm * mm / gyro.fourth  # equal turns that decide as much
    if turning < FEWEST:
        return gyro.told
    factor = gm / mm
    sigma = math.sqrt(max(0.0, gg - factor * gm) / (mm * (turning - 2.0)))
    large = LARGE + OFFSET_S * math.sqrt(gyro.changed / mm)
    sure = abs(factor - 1.0) - SURE * sigma > large
    return factor if sure or (gyro.told is not None and abs(factor - 1.0) > LARGE) else None
