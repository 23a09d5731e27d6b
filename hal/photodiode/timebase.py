"""Times of the conversions in a block, estimated from the times around transactions.

A transaction of n bytes takes ``(10 + 9 n) / f`` on the bus and a fixed overhead around it. The nominal ``f`` is
inaccurate (dividers round, core clocks are scaled). It is measured: shortest long transaction against shortest short
one. Every disturbance makes a transaction longer, so that the shortest one is undisturbed.

Blocks are anchored at their beginning. ``t0`` is read by a running thread right before its kernel call. ``t1`` is read
after the thread was woken and has regained the interpreter lock. On a busy computer that is often milliseconds late
(two cores shared with other work: 4 ms in the worst tenth of blocks), which would shift the samples by twenty chips.
Only another client of the bus can delay START; the slack is the upper bound of that delay.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import Final

from hal.photodiode.chips import CLOCKS_AROUND, CLOCKS_PER_WORD, FIRST_CLOCK

WINDOW: Final = 200
"""Blocks of a window of the minimum; the previous window counts as well, so that a minimum always exists."""
SPREAD_BLOCKS: Final = 64
STEP_BLOCKS: Final = 16
"""Consecutive blocks that exceed the minimum by more than SLOWER of their length before it is doubted."""
SLOWER: Final = 1e-3
FASTER: Final = 5e-3
"""A single block shorter than the minimum by more than this share is enough for doubt."""
LIMIT_FLOOR_S: Final = 30e-6
LIMIT_MEDIANS: Final = 8.0
"""Times the median excess: with exponential delays 0.4 % of the undisturbed blocks exceed it."""
SHORT: Final = 2
"""Bytes of the short read that measures the overhead."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of one block.

    Attributes:
        t_first: earliest ``t_mono`` of the first conversion. slack_s: upper bound of its delay after ``t_first``.
        rate_hz: conversions per second. excess_s: excess of the transaction over the shortest of its length.
        stretched: longer than usual disturbances explain, or at an unknown rate.
    """

    t_first: float
    slack_s: float
    rate_hz: float
    excess_s: float
    stretched: bool


def scl_hz(length: int, span_s: float, short_s: float) -> float:
    """SCL frequency from the durations of a ``length``-byte and a 2-byte read; 0 where they are inconsistent."""
    extra = span_s - short_s
    return 9.0 * (length - SHORT) / extra if extra > 0.0 and length > SHORT else 0.0


class SclClock:
    """Tracks the SCL frequency through a stream of equal blocks.

    Slow drift is tracked. A step of SCL and a step of the overhead look alike in blocks of one length: that sets
    :attr:`doubt`, and both must be measured again.

    Args:
        length: bytes of a block. span_s: of the best block so far. short_s: of the best 2-byte read.
        spread_s: median excess of short reads, used until enough blocks have arrived.
    """

    def __init__(self, length: int, span_s: float, short_s: float, spread_s: float = 0.0) -> None:
        self._clocks = CLOCKS_AROUND + 9 * length
        self._overhead_s = max(0.0, short_s - (CLOCKS_AROUND + 9 * SHORT) / scl_hz(length, span_s, short_s))
        self._best, self._previous, self._seen = span_s, float("inf"), 0
        self._excesses = deque([spread_s] * (SPREAD_BLOCKS // 2), maxlen=SPREAD_BLOCKS)
        self._late_in_a_row = 0
        self._late_share = 0.0
        self._faster = False
        self._least = float("inf")

    @property
    def hz(self) -> float:
        """SCL frequency."""
        return self._clocks / (self._shortest - self._overhead_s)

    @property
    def doubt(self) -> bool:
        """Whether SCL or the overhead seem to have changed since their measurement."""
        return self._faster or self._late_in_a_row >= STEP_BLOCKS

    @property
    def spread_s(self) -> float:
        """Median excess, s: the uncertainty of times around a transaction."""
        return median(self._excesses)

    @property
    def late_share(self) -> float:
        """Share of blocks that took longer than usual disturbances explain, over the latest few seconds."""
        return self._late_share

    @property
    def _shortest(self) -> float:
        return min(self._best, self._previous)

    def add(self, t0: float, t1: float) -> Timing:
        """Time one block."""
        span = t1 - t0
        self._faster |= span < (1.0 - FASTER) * self._shortest
        if self._faster:
            self._least = min(self._least, span)
        else:
            self._renew(span)
        excess = span - min(self._shortest, self._least)
        limit = max(LIMIT_FLOOR_S, LIMIT_MEDIANS * self.spread_s)
        self._late_in_a_row = self._late_in_a_row + 1 if excess > max(limit, SLOWER * span) else 0
        stretched = self.doubt or excess > limit
        if not self.doubt:  # else the spread would grow until no block counted as late
            self._excesses.append(excess)
        self._late_share += (stretched - self._late_share) / SPREAD_BLOCKS
        hz = self.hz
        slack = self._overhead_s + excess
        return Timing(t0 + FIRST_CLOCK / hz, slack, hz / CLOCKS_PER_WORD, excess, stretched)

    def _renew(self, span: float) -> None:
        self._best = min(self._best, span)
        self._seen += 1
        if self._seen == WINDOW:
            self._previous, self._best, self._seen = self._best, float("inf"), 0
