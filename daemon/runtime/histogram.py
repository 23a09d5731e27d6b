"""Histogram of durations over the last 30 to 60 s in constant memory, with its quantiles."""

from __future__ import annotations

from typing import Final

from daemon.snapshot import Spread

HALF_S: Final = 30.0
"""Duration of a half, s. Two halves are kept; the older one is dropped when the newer one is complete."""
FINE: Final = 4
"""Bits kept after the leading one: a quantile is at most 1/16 too large, and never too small."""


class Histogram:
    """Counts of durations, us, in bins of at most 1/16 relative width."""

    def __init__(self) -> None:
        self._older: dict[int, int] = {}
        self._newer: dict[int, int] = {}
        self._older_max = self._newer_max = 0

    def add(self, us: int) -> None:
        """Counts one duration, us."""
        shift = us.bit_length() - FINE - 1
        step = (shift << FINE) + (us >> shift) if shift > 0 else us
        self._newer[step] = self._newer.get(step, 0) + 1
        if us > self._newer_max:
            self._newer_max = us

    def turn(self) -> None:
        """Drops the older half."""
        self._older, self._older_max = self._newer, self._newer_max
        self._newer, self._newer_max = {}, 0

    def spread(self) -> Spread | None:
        """Returns median, 99 % quantile and maximum, us; None if nothing was counted."""
        counts = dict(self._older)
        for step, count in self._newer.items():
            counts[step] = counts.get(step, 0) + count
        total = sum(counts.values())
        if total == 0:
            return None
        largest = max(self._older_max, self._newer_max)
        found = [min(largest, _upper(_step_at(counts, part * total))) for part in (0.50, 0.99)]
        return found[0], found[1], largest


def _step_at(counts: dict[int, int], rank: float) -> int:
    """Returns the bin of the ``rank``-th smallest value."""
    below, last = 0, 0
    for last in sorted(counts):
        below += counts[last]
        if below >= rank:
            break
    return last


def _upper(step: int) -> int:
    """Returns the largest value of a bin, us."""
    shift = max(0, (step >> FINE) - 1)
    return ((step - (shift << FINE) + 1) << shift) - 1
