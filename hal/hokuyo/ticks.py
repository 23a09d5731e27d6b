"""From the sensor's 24-bit millisecond stamps to ``t_mono``, without a word to the sensor.

Three stages, each a class:

1. :class:`Unwrapper` decides what a stamp is: the next revolution, a wrap, a repeat, a damaged or restarted clock.
2. :class:`Revolutions` finds the fraction of the millisecond that the stamp cut off: the motor turns evenly, so a run
   of whole milliseconds around an uneven period pins it down like a vernier.
3. :class:`Envelope` maps sensor seconds to host seconds. Arrival is never early, only late, so the truth is the lower
   edge of (arrival - stamp). The line under all points that lies closest to them is an edge of their convex hull
   (Moon, Skelly, Towsley: "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).

A stamp names the moment the beam passes step 0 (SCIP 2.0, C-42-03320B); because the map is made from the same stamps,
a constant error of a firmware's stamps cancels, and only the constant way from step 0 to arrival must be known.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Final

from hal.hokuyo.scip import TICK_MODULUS

SLOPE_LIMIT: Final = 1.5e-3  # of sensor clock against host clock; quartz does 50e-6, accept much worse
_BIN_S: Final = 0.25
_WINDOW_S: Final = 30.0
_SETTLED_SCANS: Final = 20
_STUCK_REPEATS: Final = 2
_AHEAD_S: Final = 0.5  # a first scan may have been late by this much when it set the scale
_AHEAD_SETTLED_S: Final = 0.015
_EARLY_S: Final = 0.002  # earlier than ever before by this: believed when it happens again and again
_EARLY_BELIEVED: Final = 3
_LAG_S: Final = 0.020  # a lag that outlasts _LAG_BINS was a jump of the clock, not a queue
_LAG_BINS: Final = 40


class Verdict(Enum):
    """What a stamp turned out to be."""

    GOOD = "good"
    REPEATED = "the same stamp again"
    DOUBTFUL = "does not continue the clock"
    RESTARTED = "the clock has restarted"


class Unwrapper:
    """24-bit milliseconds to an integer that never wraps, guided by the time of arrival.

    A stamp that does not continue the clock is held back: if the next one continues it, a reset has happened and a new
    epoch begins there; if the next one fits the old clock, one frame was damaged and nothing has happened.
    """

    def __init__(self, nominal_ms: float) -> None:
        self._nominal_ms = nominal_ms
        self.restart()

    def restart(self) -> None:
        """Forget everything: the next stamp begins an epoch."""
        self.last = -1
        self._t_last = 0.0
        self._repeats = 0
        self._doubtful: tuple[int, float] | None = None

    @property
    def stuck(self) -> bool:
        """True once the same stamp has come more than twice in a row."""
        return self._repeats >= _STUCK_REPEATS

    def feed(self, stamp: int, t_rx: float, newest_ms: float, ahead_ms: float, period_ms: float) -> Verdict:
        """Judge a stamp; on GOOD and RESTARTED :attr:`last` is its unwrapped value.

        Args:
            stamp: 0..2**24-1, ms.
            t_rx: arrival, s.
            newest_ms: unwrapped stamp of a scan that would arrive now without any delay.
            ahead_ms: how far past that a stamp may lie.
            period_ms: learned time between scans on the sensor's clock, 0 while unknown.
        """
        if self.last < 0:
            return self._accept(stamp, t_rx, Verdict.GOOD)
        if stamp == self.last % TICK_MODULUS and t_rx - self._t_last < TICK_MODULUS / 2e3:
            self._repeats += 1
            return Verdict.REPEATED
        unwrapped = stamp + TICK_MODULUS * round((newest_ms - stamp) / TICK_MODULUS)
        ahead = unwrapped - newest_ms
        step_ms = unwrapped - self.last
        if ahead <= ahead_ms and step_ms > 0:
            as_long = abs(step_ms - 1000.0 * (t_rx - self._t_last)) < 0.2 * self._nominal_ms  # then the motor changes
            if as_long or _whole_revolutions(step_ms, period_ms):
                return self._accept(unwrapped, t_rx, Verdict.GOOD)
        before, self._doubtful = self._doubtful, (stamp, t_rx)
        if before is not None and self._continues(before, stamp, t_rx):
            return self._accept(stamp, t_rx, Verdict.RESTARTED)
        return Verdict.DOUBTFUL

    def _accept(self, unwrapped: int, t_rx: float, verdict: Verdict) -> Verdict:
        self.last, self._t_last = unwrapped, t_rx
        self._repeats = 0
        self._doubtful = None
        return verdict

    def _continues(self, before: tuple[int, float], stamp: int, t_rx: float) -> bool:
        step_ms = (stamp - before[0]) % TICK_MODULUS
        host_ms = 1000.0 * (t_rx - before[1])
        return 0 < step_ms <= host_ms + 1000.0 * _AHEAD_S and step_ms < 20 * self._nominal_ms + 2 * host_ms


def _whole_revolutions(step_ms: float, period_ms: float) -> bool:
    """False where a step of the stamp is no multiple of the period (and not too long to tell)."""
    if period_ms <= 0:
        return True
    turns = round(step_ms / period_ms)
    if turns > 50:
        return True
    return turns > 0 and abs(step_ms - turns * period_ms) <= 2.0 + 0.02 * period_ms * (turns + 3)


class Revolutions:
    """Sensor time of each scan in fractional ms, from whole ms and the evenness of the motor.

    Attributes:
        exact_ms: of the latest scan. period_ms: learned time between two scans of the stream.
        steady: False while the motor changes its speed, and shortly after.
    """

    def __init__(self, nominal_ms: float) -> None:
        self._nominal_ms = nominal_ms
        self.restart()

    def restart(self) -> None:
        """Forget the phase and the learned period."""
        self.exact_ms = -1.0
        self.period_ms = self._nominal_ms
        self.steady = True
        self._index = 0
        self._anchors: deque[tuple[int, float]] = deque()

    @property
    def learned(self) -> bool:
        """True once the period rests on measurements."""
        return self._index >= _SETTLED_SCANS

    def feed(self, unwrapped: int) -> int:
        """Take the next unwrapped stamp; returns how many periods have passed since the one before (0 at the first)."""
        if self.exact_ms < 0:
            self.exact_ms = unwrapped + 0.5
            self._anchors.append((0, self.exact_ms))
            return 0
        step_ms = unwrapped - self.exact_ms
        turns = max(1, round(step_ms / self.period_ms))
        self._index += turns
        predicted = self.exact_ms + turns * self.period_ms
        self.exact_ms = min(max(predicted, float(unwrapped)), unwrapped + 1.0)
        if abs(self.exact_ms - predicted) > 2.0 + 0.02 * self.period_ms * turns:
            self._begin_again(unwrapped, step_ms)
        else:
            self._learn()
            self.steady = self.steady or self._index >= 5
        return turns

    def _begin_again(self, unwrapped: int, step_ms: float) -> None:
        """The motor has changed its speed: learn from here on."""
        self.exact_ms = unwrapped + 0.5
        if step_ms < 3.0 * self._nominal_ms:
            self.period_ms = max(step_ms, 0.3 * self._nominal_ms)
        self.steady = False
        self._index = 0
        self._anchors.clear()
        self._anchors.append((0, self.exact_ms))

    def _learn(self) -> None:
        oldest_index, oldest_ms = self._anchors[0]
        turns, span = self._index - oldest_index, self.exact_ms - oldest_ms
        if turns >= 4:
            self.period_ms = span / turns
        if self.exact_ms - self._anchors[-1][1] >= 1000.0:
            self._anchors.append((self._index, self.exact_ms))
            if span > 1000.0 * _WINDOW_S:
                self._anchors.popleft()


class Envelope:
    """Lower edge of (arrival - stamp) over a sliding window, as a line in sensor time."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget all points."""
        self._bins: deque[tuple[float, float]] = deque()  # lowest point of each quarter second: (x, delay)
        self._bin_end = -math.inf
        self._slope = 0.0
        self._base = 0.0
        self._x0 = 0.0
        self._lagging = 0

    @property
    def slope(self) -> float:
        """Host seconds per sensor second, less one."""
        return self._slope

    @property
    def lag_lasts(self) -> bool:
        """True when everything of the last ten seconds came late by the same and more: the sensor's clock has moved."""
        return self._lagging >= _LAG_BINS

    def delay(self, x: float) -> float:
        """Arrival less stamp of an undelayed scan, at sensor time ``x``; seconds."""
        return self._base + self._slope * (x - self._x0)

    def feed(self, x: float, delay: float) -> float:
        """Take a point; returns its excess over the edge as now known, >= 0, in seconds."""
        if not self._bins:
            self._x0, self._base = x, delay
        excess = delay - self.delay(x)
        if x >= self._bin_end:
            self._open_bin(x, delay)
        elif excess < self._bins[-1][1] - self.delay(self._bins[-1][0]):
            self._bins[-1] = (x, delay)
        if excess < 0:
            self._base += excess
            self._fit()
        return max(0.0, delay - self.delay(x))

    def _open_bin(self, x: float, delay: float) -> None:
        if self._bins:
            last_x, last_delay = self._bins[-1]
            self._lagging = self._lagging + 1 if last_delay - self.delay(last_x) > _LAG_S else 0
        self._bins.append((x, delay))
        while self._bins[0][0] < x - _WINDOW_S:
            self._bins.popleft()
        self._bin_end = x + _BIN_S
        self._fit()

    def _fit(self) -> None:
        """Tangent of the lower hull under the middle of the window, its slope limited."""
        hull: list[tuple[float, float]] = []
        for point in self._bins:
            while len(hull) > 1 and _turns_right(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        middle = sum(x for x, _ in self._bins) / len(self._bins)
        slope = 0.0
        for (x0, y0), (x1, y1) in itertools.pairwise(hull):
            slope = (y1 - y0) / (x1 - x0)
            if x1 >= middle:
                break
        self._slope = min(max(slope, -SLOPE_LIMIT), SLOPE_LIMIT)
        self._x0 = self._bins[-1][0]
        self._base = min(y + self._slope * (self._x0 - x) for x, y in hull)


def _turns_right(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])


@dataclass(frozen=True, slots=True)
class ScanTime:
    """When a scan was: ``t_mono`` of step 0, its one-sigma, periods since the scan before (1: none is missing)."""

    t_mono: float
    t_sigma: float
    periods: int


class TickClock:
    """All three stages for one stream of stamps.

    Args:
        period_s: nominal time between two scans of the stream.
        sweep: periods from the beam at step 0 to the moment at which the data are complete.
        line_s: time the bytes of a scan take on the line, undelayed.
        latency_sigma_s: how well both are known.
    """

    def __init__(self, period_s: float, sweep: float, line_s: float, latency_sigma_s: float = 2e-4) -> None:
        self._sweep = sweep
        self._line_s = line_s
        self._latency_sigma_s = latency_sigma_s
        self._unwrapper = Unwrapper(1000.0 * period_s)
        self._revolutions = Revolutions(1000.0 * period_s)
        self._envelope = Envelope()
        self._count = 0
        self._excess = 0.0
        self._early = 0
        self._t_last = -math.inf
        self.resets = 0

    @property
    def stuck(self) -> bool:
        """The sensor repeats one stamp."""
        return self._unwrapper.stuck

    @property
    def period_s(self) -> float:
        """Learned time between scans in host seconds."""
        return self._revolutions.period_ms * 1e-3 * (1.0 + self._envelope.slope)

    @property
    def skew(self) -> float:
        """Learned rate of host clock over sensor clock, less one."""
        return self._envelope.slope

    def restart(self) -> None:
        """Begin a new epoch: after a reconnect, or when the sensor was reset on purpose."""
        self._unwrapper.restart()
        self._begin_epoch()

    def feed(self, stamp: int, t_rx: float) -> ScanTime | None:
        """Time a scan by its stamp and arrival; None where no time can be told without guessing (drop the scan)."""
        newest_ms, ahead_ms = self._expect(t_rx)
        period_ms = self._revolutions.period_ms if self._revolutions.learned else 0.0
        verdict = self._unwrapper.feed(stamp, t_rx, newest_ms, ahead_ms, period_ms)
        if verdict is Verdict.RESTARTED:
            self._note_reset()
        elif verdict is not Verdict.GOOD:
            return None
        periods = self._revolutions.feed(self._unwrapper.last)
        x = 1e-3 * self._revolutions.exact_ms
        delay = t_rx - x - self._sweep * 1e-3 * self._revolutions.period_ms
        if self._believable(x, delay):
            excess = self._envelope.feed(x, delay)
            self._excess += (excess - self._excess) / min(self._count + 1, 200)
        if self._envelope.lag_lasts:
            self._note_reset()
            self._unwrapper.restart()
            return None
        self._count += 1
        t_mono = x + self._envelope.delay(x) - self._line_s
        if t_mono <= self._t_last:
            return None
        self._t_last = t_mono
        return ScanTime(t_mono, self._sigma(), max(1, periods))

    def _believable(self, x: float, delay: float) -> bool:
        """False for a delay that says more about a motor in change than about the clocks."""
        if self._count == 0:
            return True
        early = self._count >= _SETTLED_SCANS and delay < self._envelope.delay(x) - _EARLY_S
        self._early = self._early + 1 if early else 0
        return self._revolutions.steady and (not early or self._early >= _EARLY_BELIEVED)

    def _expect(self, t_rx: float) -> tuple[float, float]:
        """Newest stamp that could arrive now, and how far past that is still believed; ms."""
        if self._unwrapper.last < 0:
            return 0.0, 0.0
        sweep_s = self._sweep * 1e-3 * self._revolutions.period_ms
        x = 1e-3 * self._unwrapper.last
        for _ in range(2):  # t = x + sweep + delay(x), solved for x
            x = t_rx - sweep_s - self._envelope.delay(x)
        settled = self._count >= _SETTLED_SCANS
        gap = max(0.0, x - 1e-3 * self._unwrapper.last)
        ahead = (_AHEAD_SETTLED_S if settled else _AHEAD_S) + SLOPE_LIMIT * gap
        return 1000.0 * x, 1000.0 * ahead

    def _note_reset(self) -> None:
        self.resets += 1
        self._begin_epoch()

    def _begin_epoch(self) -> None:
        self._revolutions.restart()
        self._envelope.restart()
        self._count = 0
        self._excess = 0.0

    def _sigma(self) -> float:
        """Cut-off milliseconds and an edge not yet reached, with the latency's own uncertainty."""
        early = 0.01 if self._count < 3 else self._excess / math.sqrt(self._count)
        fraction = 5e-4 / math.sqrt(min(self._count, 25))
        return math.hypot(early, fraction, 1e-4, self._latency_sigma_s)
