"""How much later the laser's stamps are than the wheels', from the robot's turning as both have seen it.

A line that delays every scan alike cannot be heard in the scans' own stamps. But a robot begins to turn, and ends it,
at one instant: if the yaw that matches have shown from scan to scan is what the wheels counted some time earlier, the
scans are stamped late by that much, or the wheels early. The increments ``m`` of matches are held against those ``w``
of the wheels at each of :data:`LAGS`. The wheels' scale ``a`` is free, and ``R = sum (m - a w)^2`` is least at the lag.
While the robot stands, drives straight or turns evenly, all lags say the same, and nothing is added.

Wheels that slip when a turn begins look early, too. So what a lag leaves over must be next to nothing, and any one
stretch of the evidence may be left out: it takes the begin of a turn and the end of one, or more of them.
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
"""Lags that are tried, s: wheels late by 0.4 s, laser late by 0.6 s; the first and the last are no answers."""
NONE: Final = 8
"""Index of no lag."""

APART_S: Final = 0.08
"""Matches nearer together are left out: the turn between them is less above their noise."""
LONGEST_S, SILENT_S = 0.5, 2.0
"""Longest time between two matches, or two readings of the wheels; a silence after which all may be otherwise."""
STRETCH_S: Final = 0.02
"""Readings are put together up to this length; they may come a thousand times a second."""
DEPTH: Final = 256
"""Points of the wheels' way that are kept: 2.5 s and more."""
HELD_YAW: Final = 1e4
"""Information of a match's yaw from which on it is one: 0.6 deg."""
TELLING_RAD: Final = 0.02
"""By how much an increment of the wheels has to differ from lag to lag to say something about it."""
BLOCK, BLOCKS = 4, 10
"""Increments that say something are added up in blocks of so many; the latest so many blocks are remembered."""

NOISE_RAD: Final = 0.003
"""One sigma of an increment at its best: two matches, encoder steps."""
LEFT, STILL_LEFT = 0.1, 0.3
"""Share of what is left over without a lag that may be with it; the greater one where it has been told already, and
where two blocks are left out."""
REFUTED, STILL_REFUTED, OTHERS = 50.0, 16.0, 9.0
"""By how many variances of an increment none, and each lag of the other sign, has to be worse: seven sigma; four where
two blocks are left out; and any lag beyond :data:`NEAR` steps: evenly weaving looks alike after each period."""
NEAR: Final = 3
SCALE: Final = (0.5, 2.0)
"""Laser's turn by wheels' turn: beyond, they do not tell of the same."""
STAMPS_S: Final = 0.005
"""One sigma of what stamps, and the time that a sweep takes, leave open."""
LEAST_S, SIGMAS = 0.1, 3.0
"""A lag that is told is greater than this by so many of its deviations; once told, half of it will do.

Stamps at the arrival of scans whose sweep nobody knows are late by 0.09 s, filters in motor controllers by 0.07 s: both
in logs of robots that nothing was wrong with.
"""


@dataclass(slots=True, eq=False)
class TimeOffset:
    """What is remembered.

    Attributes:
        told: the lag, None: none is beyond doubt.
        times, turned: (2 DEPTH,) the wheels' way, s and rad. points: how many count.
        waiting: scans that the wheels have not reached yet: end of the sweep, yaw (no number: not matched). newest: end
            of the latest that matched.
        before: the latest that they have reached, and their turn at its instant less each of :data:`LAGS`.
        sums: (BLOCKS, 2, lags) of ``m w`` and ``w w``. own: (BLOCKS, 2) count, and sum of ``m m``. block: being filled.
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
        """What was before says nothing of what comes; the wheels' way stays."""
        self.told, self.before, self.newest, self.block = None, None, -math.inf, 0
        self.waiting.clear()
        self.sums[:] = self.own[:] = 0.0


def on_odometry(lag: TimeOffset, record: Odometry) -> None:
    """Follow the wheels. A reading that does not follow on the last one, and a laser's silence, end what was known."""
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
    """Take in a match. Stamps that have gone back, and wheels that are silent, end what was known."""
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
    """Hold the turn that a match at an instant has shown since the one before against the wheels', at each lag."""
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
    """R at each lag, (..., lags), of sums (..., 2, lags) and (..., 2)."""
    return np.asarray(own[..., 1:] - sums[..., 0, :] ** 2 / np.maximum(sums[..., 1, :], NOISE_RAD**2))


def judged(lag: TimeOffset) -> Lag | None:
    """The lag, where it is beyond doubt; one that has been told stays until there is some."""
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
    """R, (n, lags), with each two blocks in a row left out that hold something.

    Slip is over within two blocks: it would have to come again, and in the same way, to speak for a lag in all rows.
    """
    sums, own = lag.sums + np.roll(lag.sums, 1, 0), lag.own + np.roll(lag.own, 1, 0)
    R = left_over(lag.sums.sum(0) - sums, lag.own.sum(0) - own)
    return np.asarray(R[own[:, 0] > 0.0])


def stands(R: Array, best: int, wrong: slice, variance: float) -> bool:
    """Whether a lag, by its index, stands in each row; ``wrong``: lags that it denies."""
    clear = R[:, wrong].min(1) - R[:, best] >= STILL_REFUTED * variance
    return bool((clear & (R[:, best] <= STILL_LEFT * R[:, NONE])).all())


def scatter(R: Array, tau: float) -> float:
    """Variance of the lag ``tau`` by how far the rows' lags lie from it (jackknife, two of n left out)."""
    rows, best = np.arange(len(R)), np.clip(R.argmin(1), 1, len(LAGS) - 2)
    before, here, after = R[rows, best - 1], R[rows, best], R[rows, best + 1]
    bend = np.maximum(before - 2.0 * here + after, NOISE_RAD**2)
    off = LAGS[best] + STEP_S * np.clip(0.5 * (before - after) / bend, -1.0, 1.0) - tau
    return max(0.5 * len(R) - 1.0, 1.0) * float(np.mean(off * off))
