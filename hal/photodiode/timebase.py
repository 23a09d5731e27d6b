"""When the conversions of a block took place, from nothing but the times around transactions.

A transaction of n bytes takes ``(10 + 9 n) / f`` on the bus and a fixed overhead around it. The nominal ``f`` is never
right (dividers round, core clocks are scaled), so it is measured: shortest long transaction against shortest short one.
Everything that disturbs a transaction makes it longer, so the shortest is the undisturbed one.

Blocks are anchored at their beginning. ``t0`` is taken by a thread that is running, a moment before it calls the
kernel. ``t1`` is taken when it has been woken and has the interpreter's lock again: on a busy computer that is often
milliseconds late (two cores shared with other work: 4 ms in the worst tenth of blocks), which would shift the samples
by twenty chips. What can delay START is another client of the bus; by how much at most is told as slack.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import Final

from hal.photodiode.chips import CLOCKS_AROUND, CLOCKS_PER_WORD, FIRST_CLOCK

WINDOW: Final = 200
"""Blocks over which the shortest is sought; the one before counts as well, so that there is always an answer."""
SPREAD_BLOCKS: Final = 64
STEP_BLOCKS: Final = 16
"""Blocks that must all be too long, by more than SLOWER of their length, until what was measured is doubted."""
SLOWER: Final = 1e-3
FASTER: Final = 5e-3
"""One block that is shorter than ever by more than this is enough."""
LIMIT_FLOOR_S: Final = 30e-6
LIMIT_MEDIANS: Final = 8.0
"""Of the median excess: with exponential delays four undisturbed blocks in a thousand are beyond it."""
SHORT: Final = 2
"""Bytes of the short read that tells the overhead."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Where one block lies.

    Attributes:
        t_first: earliest ``t_mono`` of the first conversion. slack_s: by how much later it may have been.
        rate_hz: conversions per second. excess_s: by how much the transaction was longer than the shortest of its kind.
        stretched: longer than usual disturbances explain, or of a rate that is not known.
    """

    t_first: float
    slack_s: float
    rate_hz: float
    excess_s: float
    stretched: bool


def scl_hz(length: int, span_s: float, short_s: float) -> float:
    """SCL frequency from the spans of a read of ``length`` bytes and of a 2-byte read; 0 where they make no sense."""
    extra = span_s - short_s
    return 9.0 * (length - SHORT) / extra if extra > 0.0 and length > SHORT else 0.0


class SclClock:
    """Follows SCL through a stream of equal blocks.

    Slow drift is followed. A step of SCL and a step of the overhead look alike in blocks of one length: then there is
    :attr:`doubt`, and both have to be measured anew.

    Args:
        length: bytes of a block. span_s: of the best block so far. short_s: of the best 2-byte read.
        spread_s: median excess of short reads, for the time until blocks tell their own.
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
        """Whether SCL or the overhead seem to be other than they were measured."""
        return self._faster or self._late_in_a_row >= STEP_BLOCKS

    @property
    def spread_s(self) -> float:
        """Median excess: how well times around a transaction are known here."""
        return median(self._excesses)

    @property
    def late_share(self) -> float:
        """Share of blocks that took longer than usual disturbances explain, over the latest few seconds."""
        return self._late_share

    @property
    def _shortest(self) -> float:
        return min(self._best, self._previous)

    def take(self, t0: float, t1: float) -> Timing:
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
        if not self.doubt:  # else the spread would grow until nothing were late any more
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
