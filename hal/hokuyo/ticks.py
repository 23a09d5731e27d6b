"""Converts the sensor's 24-bit millisecond stamps to ``t_mono``, passively.

Three stages, each a class:

1. :class:`Unwrapper` classifies a stamp: the next revolution, a wrap, a repeat, a damaged or restarted clock.
2. :class:`Revolutions` recovers the truncated fraction of the millisecond: the motor turns evenly, so that a run of
   whole milliseconds resolves it like a vernier.
3. :class:`hal.hokuyo.clock_envelope.Envelope` maps sensor seconds to host seconds by the lower edge of (arrival -
stamp).

A stamp is the instant at which the beam passes step 0 (SCIP 2.0, C-42-03320B). The map is made from the same stamps, so
that a constant error of a firmware's stamps cancels. Only the constant delay from step 0 to arrival must be known.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Final

from hal.hokuyo.clock_envelope import LAG_S, SLOPE_LIMIT, Envelope
from hal.hokuyo.scip import TICK_MODULUS

_LEARN_TURNS: Final = 300  # over fewer, the resolution of a stamp shows in the period
_WINDOW_S: Final = 30.0
_DRIFT_MS: Final = 1.2  # a truncated fraction is at most 1 ms
_DRIFT_SCANS: Final = 40
_ROUGH_SCANS: Final = 10  # by then the learned period is better than the nominal one
_CORRECTED_MS: Final = 0.05
_SETTLED_SCANS: Final = 20
_STUCK_REPEATS: Final = 2
_AHEAD_S: Final = 0.5  # a first scan may have been late by this much when it set the scale
_AHEAD_SETTLED_S: Final = 0.015
_EARLY_S: Final = 0.002  # this much earlier than ever before: accepted only when repeated
_EARLY_BELIEVED: Final = 2.5  # three times in a row, or slightly less often over a longer time
_RATE_SIGMA: Final = 3e-5
_NEW_SYNC_S: Final = 20.0  # of silence: the rate is too uncertain to bridge more


class Verdict(Enum):
    """Classification of a stamp."""

    GOOD = "good"
    REPEATED = "the same stamp again"
    DOUBTFUL = "does not continue the clock"
    RESTARTED = "the clock has restarted"


class Unwrapper:
    """Unwraps 24-bit milliseconds to an integer that never wraps, with the help of the arrival time.

    A stamp that does not continue the clock is kept aside. If the next one continues it, the clock was reset and a new
    epoch begins there. If the next one fits the old clock, a single frame was damaged.
    """

    def __init__(self, nominal_ms: float) -> None:
        self._nominal_ms = nominal_ms
        self.restart()

    def restart(self) -> None:
        """Forget everything; the next stamp begins an epoch."""
        self.last = -1
        self._t_last = 0.0
        self._repeats = 0
        self._doubtful: tuple[int, float] | None = None

    @property
    def stuck(self) -> bool:
        """True once the same stamp has come more than twice in a row."""
        return self._repeats >= _STUCK_REPEATS

    def feed(self, stamp: int, t_rx: float, newest_ms: float, ahead_ms: float, period_ms: float) -> Verdict:
        """Classify a stamp; on GOOD and RESTARTED :attr:`last` is its unwrapped value.

        Args:
            stamp: 0..2**24-1, ms.
            t_rx: arrival, s.
            newest_ms: unwrapped stamp of a scan that would arrive now without delay.
            ahead_ms: how far past that a stamp may lie.
            period_ms: learned time between scans on the sensor's clock, 0 where unknown.
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
            as_long = (
                abs(step_ms - 1000.0 * (t_rx - self._t_last)) < 0.2 * self._nominal_ms
            )  # the motor changes its speed
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
    """False where a step of the stamp is no multiple of the period; True for steps too long to decide."""
    if period_ms <= 0:
        return True
    turns = round(step_ms / period_ms)
    if turns > 50:
        return True
    return turns > 0 and abs(step_ms - turns * period_ms) <= 2.0 + 0.02 * period_ms * (turns + 3)


class Revolutions:
    """Sensor time of each scan in fractional ms, from whole ms and the even rotation of the motor.

    Attributes:
        exact_ms: of the latest scan. period_ms: learned time between two scans of the stream.
        correction_ms: deviation of the latest stamp from the predicted rotation.
        steady: False while the motor changes its speed, and shortly after.
    """

    def __init__(self, nominal_ms: float) -> None:
        self._nominal_ms = nominal_ms
        self.restart()

    def restart(self) -> None:
        """Forget the phase and the learned period."""
        self.exact_ms = -1.0
        self.period_ms = self._nominal_ms
        self.correction_ms = self._drift_ms = 0.0
        self._changed = False
        self.steady = True
        self._index = 0
        self._anchors: deque[tuple[int, float]] = deque()

    @property
    def learned(self) -> bool:
        """True once the period rests on measurements."""
        return self._index >= _SETTLED_SCANS

    def feed(self, unwrapped: int) -> int:
        """Add the next unwrapped stamp; returns the number of periods since the previous one (0 at the first)."""
        if self.exact_ms < 0:
            self.exact_ms = unwrapped + 0.5
            self._anchors.append((0, self.exact_ms))
            return 0
        step_ms = unwrapped + 0.5 - self.exact_ms
        turns = max(1, round(step_ms / self.period_ms))
        predicted = self.exact_ms + turns * self.period_ms
        self.exact_ms = min(max(predicted, float(unwrapped)), unwrapped + 1.0)
        self._index += turns
        self._judge(self.exact_ms - predicted, turns, step_ms)
        self._learn()
        return turns

    def _judge(self, correction_ms: float, turns: int, step_ms: float) -> None:
        """Decide whether a deviation is the truncated fraction or a change of the motor's speed."""
        self.correction_ms = 0.0
        if abs(correction_ms) > 2.0 + 0.02 * self.period_ms * turns:
            if 0.3 * self._nominal_ms < step_ms < 3.0 * self._nominal_ms:
                self.period_ms = step_ms
            self._relearn()
        elif self._index >= (_DRIFT_SCANS if self._changed else _ROUGH_SCANS):
            self._drift_ms += correction_ms - self._drift_ms / _DRIFT_SCANS
            self.correction_ms = correction_ms
            if abs(self._drift_ms) > _DRIFT_MS:
                self._relearn()

    def _relearn(self) -> None:
        self._changed = True
        self.steady = False
        self.correction_ms = self._drift_ms = 0.0
        self._index = 0
        self._anchors.clear()
        self._anchors.append((0, self.exact_ms))

    def _learn(self) -> None:
        oldest_index, oldest_ms = self._anchors[0]
        turns, span = self._index - oldest_index, self.exact_ms - oldest_ms
        if turns >= 4:
            self.period_ms = span / turns
            self.steady = True
        if self.exact_ms - self._anchors[-1][1] >= 1000.0:
            self._anchors.append((self._index, self.exact_ms))
            if span > 1000.0 * _WINDOW_S and turns > _LEARN_TURNS:
                self._anchors.popleft()


@dataclass(frozen=True, slots=True)
class ScanTime:
    """Time of a scan: ``t_mono`` of step 0, its one-sigma (s), periods since the previous scan (1: none is missing)."""

    t_mono: float
    t_sigma: float
    periods: int


class TickClock:
    """All three stages for one stream of stamps.

    Args:
        period_s: nominal time between two scans of the stream.
        sweep: periods from the beam at step 0 to the completion of the data.
        line_s: undelayed transmission time of a scan on the line.
        latency_sigma_s: one-sigma uncertainty of both.
    """

    def __init__(self, period_s: float, sweep: float, line_s: float, latency_sigma_s: float = 2e-4) -> None:
        self._sweep = sweep
        self._line_s = line_s
        self._latency_sigma_s = latency_sigma_s
        self._unwrapper = Unwrapper(1000.0 * period_s)
        self._revolutions = Revolutions(1000.0 * period_s)
        self._envelope = Envelope(period_s)
        self._count = 0
        self._excess = 0.0
        self._early = 0.0
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
        """Begin a new epoch, after a reconnect or a deliberate reset of the sensor."""
        self._unwrapper.restart()
        self._begin_epoch()

    def feed(self, stamp: int, t_rx: float) -> ScanTime | None:
        """Time a scan by its stamp and arrival; None where the time cannot be determined (drop the scan)."""
        newest_ms, ahead_ms = self._expect(t_rx)
        period_ms = self._revolutions.period_ms if self._revolutions.learned else 0.0
        verdict = self._unwrapper.feed(stamp, t_rx, newest_ms, ahead_ms, period_ms)
        if verdict is Verdict.RESTARTED:
            self._note_reset()
        elif verdict is not Verdict.GOOD:
            return None
        if self._unwrapper.last - self._revolutions.exact_ms > 1e3 * _NEW_SYNC_S:
            self._begin_epoch()
        periods = self._revolutions.feed(self._unwrapper.last)
        x = 1e-3 * self._revolutions.exact_ms
        delay = t_rx - x - self._sweep * self.period_s
        if abs(self._revolutions.correction_ms) > _CORRECTED_MS:
            self._envelope.shift(-1e-3 * self._revolutions.correction_ms)
        if self._usable(x, delay):
            excess = self._envelope.feed(x, delay)
            if excess < LAG_S:
                self._excess += (excess - self._excess) / min(self._count + 1, 200)
        if self._envelope.lag_lasts:
            self._note_reset()
            self._unwrapper.restart()
            return None
        self._count += 1
        t_mono = x + self._envelope.delay(x) - self._line_s
        if not self._t_last < t_mono <= t_rx:  # causality: not after the arrival, not before the previous scan
            return None
        self._t_last = t_mono
        return ScanTime(t_mono, self._sigma(x), max(1, periods))

    def _usable(self, x: float, delay: float) -> bool:
        """False for a delay that is dominated by a change of the motor's speed, or is implausibly early."""
        if self._count == 0:
            return True
        early = self._count >= _SETTLED_SCANS and delay < self._envelope.delay(x) - _EARLY_S
        self._early = 0.9 * self._early + early
        return self._revolutions.steady and (not early or self._early > _EARLY_BELIEVED)

    def _expect(self, t_rx: float) -> tuple[float, float]:
        """Newest stamp that could arrive now, and the tolerance past it; ms."""
        if self._unwrapper.last < 0:
            return 0.0, 0.0
        sweep_s = self._sweep * self.period_s
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

    def _sigma(self, x: float) -> float:
        """One-sigma of a scan's time, s: truncation, distance from the envelope, age of its last edge, latency."""
        early = 0.01 if self._count < 3 else max(self._excess / math.sqrt(self._count), 5e-3 / self._count)
        fraction = 5e-4 / math.sqrt(min(self._count, 25))
        bridged = _RATE_SIGMA * self._envelope.age(x)
        return math.hypot(early, fraction, bridged, 1e-4, self._latency_sigma_s)
