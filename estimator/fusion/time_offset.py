"""Time offset between scan stamps and odometry stamps, from the rotation that both measure.

A constant delay of all scans is not visible in their own stamps. But a robot begins and ends a rotation at one instant.
If the yaw of matches follows that of odometry with a delay, scans are stamped that late, or odometry early. The yaw
increments ``m`` of matches are compared with those ``w`` of odometry at each of :data:`LAGS`. The odometry scale ``a``
is free, and ``R = sum (m - a w)^2`` is smallest at the offset. At rest, straight ahead and at a constant turn rate all
offsets are equal, and nothing is added.

Wheels that slip at the begin of a turn look early, too. So the remaining sum must be small. The result must also not
depend on any one segment of the data. It needs the begin and the end of a turn, or several.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from estimator.measurements import Odometry, Scan
from estimator.numerics.arrays import Array
from estimator.result import Lag, MatchResult, Reason

STEP_S: Final = 0.05
LAGS: Final = STEP_S * np.arange(-8, 13)
"""Offsets tried, s: odometry late by 0.4 s to lidar late by 0.6 s; the first and the last are never results."""
NONE: Final = 8
"""Index of offset 0."""

APART_S: Final = 0.08
"""Shortest time between two matches in use, s: over less time the rotation is not above their noise."""
LONGEST_S, SILENT_S = 0.5, 2.0
"""Longest time between two matches, or two odometry readings, s; a gap after which the offset may have changed, s."""
STRETCH_S: Final = 0.02
"""Readings are merged up to this length, s; they may come a thousand times a second."""
DEPTH: Final = 256
"""Points of the odometry path that are kept: 2.5 s and more."""
HELD_YAW: Final = 1e4
"""Smallest information of a match's yaw: 0.6 deg."""
TELLING_RAD: Final = 0.02
"""Smallest range of an odometry increment over the offsets, rad; below it the increment is not informative."""
BLOCK, BLOCKS = 4, 10
"""Informative increments per block, and number of blocks kept."""

NOISE_RAD: Final = 0.003
"""Smallest sigma of an increment, rad: two matches, encoder steps."""
LEFT, STILL_LEFT = 0.1, 0.3
"""Largest share of the offset-free sum that may remain; the larger value applies to a reported offset.

The larger value also applies with two blocks omitted.
"""
REFUTED, STILL_REFUTED, OTHERS = 50.0, 16.0, 9.0
"""Required excess, in variances of an increment, of offset 0 and each offset of the other sign: seven sigma.

Four sigma with two blocks omitted. OTHERS applies to any offset more than :data:`NEAR` steps away, because a regular
weaving motion repeats after each period.
"""
NEAR: Final = 3
SCALE: Final = (0.5, 2.0)
"""Limits of the lidar's rotation over that of odometry; outside, they do not measure the same motion."""
STAMPS_S: Final = 0.005
"""One sigma of what stamps, and the duration of a scan, leave open."""
LEAST_S, SIGMAS = 0.1, 3.0
"""Smallest reported offset, s, exceeded by so many of its sigmas; half of it suffices once it is reported.

Scans stamped at their arrival, with unknown duration, are late by 0.09 s; filters in motor controllers cause 0.07 s.
Both occur in logs of robots without a fault.
"""


@dataclass(slots=True, eq=False)
class TimeOffset:
    """State of the time offset estimator.

    Attributes:
        told: the reported offset, None: none is certain.
        times, turned: (2 DEPTH,) the odometry path, s and rad.
        points: number of valid entries.
        waiting: scans that odometry has not reached yet: end of the scan, yaw (NaN: not matched).
        newest: end of the latest scan that matched.
        before: the latest scan that odometry has reached, and the odometry yaw at its instant less each of
            :data:`LAGS`.
        sums: (BLOCKS, 2, lags) of ``m w`` and ``w w``.
        own: (BLOCKS, 2) count, and sum of ``m m``.
        block: index of the block being filled.
    """

    told: Lag | None = None
    times: Array = field(default_factory=lambda: np.zeros(2 * DEPTH))
    turned: Array = field(default_factory=lambda: np.zeros(2 * DEPTH))
    points: int = 0
    waiting: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=DEPTH))
    newest: float = -math.inf
    before: tuple[float, float, Array] | None = None
    sums: Array = field(default_factory=lambda: np.zeros((BLOCKS, 2, len(LAGS))))
    own: Array = field(default_factory=lambda: np.zeros((BLOCKS, 2)))
    block: int = 0

    def forget(self) -> None:
        """Clear the estimate and its sums, where the past does not predict the future; the odometry path stays."""
        self.told, self.before, self.newest, self.block = None, None, -math.inf, 0
        self.waiting.clear()
        self.sums[:] = self.own[:] = 0.0


def on_odometry(lag: TimeOffset, record: Odometry) -> None:
    """Add an odometry reading. A gap in the readings, or in the matches, clears the estimate."""
    t_end, yaw, last = record.t_end, float(record.delta[2]), lag.points - 1
    follows = last >= 0 and abs(record.t_begin - lag.times[last]) < 1e-6 and 0.0 <= t_end - record.t_begin <= LONGEST_S
    if not (follows and math.isfinite(yaw)):
        lag.forget()
        lag.times[0], lag.turned[0], lag.points = t_end, 0.0, int(math.isfinite(t_end))
        return
    yaw += float(lag.turned[last])
    if last == 0 or t_end - lag.times[last - 1] > STRETCH_S:
        last += 1
        if last == 2 * DEPTH:
            lag.times[:DEPTH], lag.turned[:DEPTH] = lag.times[DEPTH:], lag.turned[DEPTH:]
            last = DEPTH
    lag.times[last], lag.turned[last], lag.points = t_end, yaw, last + 1
    if SILENT_S < t_end - lag.newest < math.inf:
        lag.forget()


def on_match(lag: TimeOffset, scan: Scan, match: MatchResult) -> None:
    """Add a match. Stamps that go backwards, and odometry without data, clear the estimate."""
    if not lag.points:
        return
    if match.reason is Reason.LATE or scan.t_end - lag.times[lag.points - 1] > SILENT_S:
        lag.forget()
        return
    if match.ok and match.information[2, 2] > HELD_YAW:
        if 0.0 <= scan.t_end - lag.newest < APART_S:
            return
        lag.newest = scan.t_end
        lag.waiting.append((scan.t_end, float(match.T_odom_base[2])))
    else:
        lag.waiting.append((scan.t_end, math.nan))
    while lag.waiting and lag.waiting[0][0] - LAGS[0] <= lag.times[lag.points - 1]:
        compare(lag, *lag.waiting.popleft())


def compare(lag: TimeOffset, t_mono: float, yaw: float) -> None:
    """Compare the yaw increment of two successive matches with that of odometry, at each offset."""
    if t_mono - LAGS[-1] < lag.times[0]:
        lag.before = None
        return
    wheels = np.interp(t_mono - LAGS, lag.times[: lag.points], lag.turned[: lag.points])
    before, lag.before = lag.before, (t_mono, yaw, wheels)
    if before is None or not 0.0 < t_mono - before[0] <= LONGEST_S:
        return
    w, m = wheels - before[2], math.remainder(yaw - before[1], 2.0 * math.pi)
    if not (math.isfinite(m) and w.max() - w.min() > TELLING_RAD):
        return
    block = lag.block
    lag.sums[block, 0] += m * w
    lag.sums[block, 1] += w * w
    lag.own[block] += 1.0, m * m
    if lag.own[block, 0] >= BLOCK:
        lag.told = judged(lag)
        lag.block = block = (block + 1) % BLOCKS
        lag.sums[block] = lag.own[block] = 0.0


def left_over(sums: Array, own: Array) -> Array:
    """R at each offset, (..., lags), of sums (..., 2, lags) and (..., 2)."""
    return np.asarray(own[..., 1:] - sums[..., 0, :] ** 2 / np.maximum(sums[..., 1, :], NOISE_RAD**2))


def judged(lag: TimeOffset) -> Lag | None:
    """The offset, if it is certain; a reported one stays until it becomes uncertain."""
    sums, own = lag.sums.sum(0), lag.own.sum(0)
    R, count = left_over(sums, own), float(own[0])
    best = int(R.argmin())
    if not 0 < best < len(LAGS) - 1 or not SCALE[0] <= sums[0, best] / max(sums[1, best], NOISE_RAD**2) <= SCALE[1]:
        return None
    before, here, after = R[best - 1 : best + 2].tolist()
    bend, slope = before - 2.0 * here + after, 0.5 * (before - after)
    if bend <= 0.0:
        return None
    least = max(here - 0.5 * slope * slope / bend, 0.0)
    variance = max(least / max(count - 2.0, 1.0), NOISE_RAD**2)
    wrong = slice(0, NONE + 1) if best > NONE else slice(NONE, None)
    others = np.concatenate((R[: max(0, best - NEAR + 1)], R[best + NEAR :]))
    clear = R[wrong].min() - least >= REFUTED * variance and others.min() - least >= OTHERS * variance
    if not clear or least > (STILL_LEFT if lag.told else LEFT) * R[NONE]:
        return None
    parts = left_out(lag)
    if lag.told is None and not stands(parts, best, wrong, variance):
        return None
    tau = float(LAGS[best]) + STEP_S * slope / bend
    sigma = math.sqrt(2.0 * variance / bend * STEP_S**2 + scatter(parts, tau) + STAMPS_S**2)
    return Lag(tau, sigma) if abs(tau) - SIGMAS * sigma > (0.5 * LEAST_S if lag.told else LEAST_S) else None


def left_out(lag: TimeOffset) -> Array:
    """R, (n, lags), with each two consecutive non-empty blocks omitted.

    Slip ends within two blocks. It would have to repeat in the same way to support an offset in every row.
    """
    sums, own = lag.sums + np.roll(lag.sums, 1, 0), lag.own + np.roll(lag.own, 1, 0)
    R = left_over(lag.sums.sum(0) - sums, lag.own.sum(0) - own)
    return np.asarray(R[own[:, 0] > 0.0])


def stands(R: Array, best: int, wrong: slice, variance: float) -> bool:
    """Whether the offset of index ``best`` is supported in each row; ``wrong``: offsets that it excludes."""
    clear = R[:, wrong].min(1) - R[:, best] >= STILL_REFUTED * variance
    return bool((clear & (R[:, best] <= STILL_LEFT * R[:, NONE])).all())


def scatter(R: Array, tau: float) -> float:
    """Variance of the offset ``tau`` from the spread of the rows' offsets (jackknife, two of n omitted)."""
    rows, best = np.arange(len(R)), np.clip(R.argmin(1), 1, len(LAGS) - 2)
    before, here, after = R[rows, best - 1], R[rows, best], R[rows, best + 1]
    bend = np.maximum(before - 2.0 * here + after, NOISE_RAD**2)
    off = LAGS[best] + STEP_S * np.clip(0.5 * (before - after) / bend, -1.0, 1.0) - tau
    return max(0.5 * len(R) - 1.0, 1.0) * float(np.mean(off * off))
