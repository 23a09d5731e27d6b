"""Online calibration of the gyro's scale: its turn rates against those of the matches.

A gyro with a wrong unit, sign or axis measures a multiple of the true turn rate. The factor is the slope of a
regression of its rates on those between two matches. The intercept is its bias. A gyro with a large error of the factor
is named and not used: its small noise would outweigh every other sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from estimator.measurements import Imu
from estimator.numerics.arrays import Array

MEMORY, FEWEST = 100, 8
"""Matches that the estimate remembers, 2 to 10 s of them, and the fewest before an error is named."""
TURNING: Final = 0.05
"""Least deviation (rad/s) of the true turn rate: below it, noise of the matches would decide."""
LARGE, SURE = 0.3, 3.0
"""Error of the factor that is large, and sigmas by which it must exceed that. Sound gyros are right to 3 %; a time
offset of 0.1 s in a drive of sharp turns looks like 20 %."""
FASTEST: Final = 10.0
"""Turn rate (rad/s) that no indoor robot reaches; readings in degrees exceed it from 0.2 rad/s on."""
COVERED: Final = 0.3
"""Largest share of the time between two matches that the readings may leave out, or exceed."""


@dataclass(slots=True, eq=False)
class GyroCalibration:
    """State of the calibration.

    Attributes:
        turned_rad, span_s: sums of the readings since the latest match.
        count: number of pairs of rates.
        mean, square: mean (2,) and covariance (2, 2) of the rates (gyro, matches), rad/s.
        told: factor of the readings over the true turn, None while it is about 1 or unknown.
    """

    turned_rad: float = 0.0
    span_s: float = 0.0
    count: int = 0
    mean: Array = field(default_factory=lambda: np.zeros(2))
    square: Array = field(default_factory=lambda: np.zeros((2, 2)))
    told: float | None = None


def usable(gyro: GyroCalibration, record: Imu) -> bool:
    """Register a reading; returns whether it may be used."""
    dt = record.t_end - record.t_begin
    if dt > 0.0 and math.isfinite(record.dyaw) and math.isfinite(dt):
        gyro.turned_rad += record.dyaw
        gyro.span_s += dt
    return gyro.told is None and not abs(record.dyaw) > FASTEST * dt


def on_match(gyro: GyroCalibration, turned_rad: float, dt: float) -> None:
    """Compare the readings since the latest match with its turn over ``dt`` seconds."""
    turned, span = gyro.turned_rad, gyro.span_s
    gyro.turned_rad = gyro.span_s = 0.0
    if not (dt > 0.0 and abs(span - dt) < COVERED * dt and math.isfinite(turned)):
        return
    gyro.count += 1
    share = max(1.0 / gyro.count, 1.0 / MEMORY)
    off = np.array((turned / span, turned_rad / dt)) - gyro.mean
    gyro.mean = gyro.mean + share * off
    gyro.square = (1.0 - share) * (gyro.square + share * np.outer(off, off))
    gyro.told = judged(gyro)


def judged(gyro: GyroCalibration) -> float | None:
    """The factor, where it is large; one that was named ends when it is no longer."""
    (gg, gm), (_, mm) = gyro.square.tolist()
    if gyro.count < FEWEST or mm < TURNING**2:
        return gyro.told
    factor = gm / mm
    sigma = math.sqrt(max(0.0, gg - factor * gm) / (mm * min(gyro.count, MEMORY)))
    sure = abs(factor - 1.0) - SURE * sigma > LARGE
    return factor if sure or (gyro.told is not None and abs(factor - 1.0) > LARGE) else None
