"""The spinning head: when the sensor passes step 0 of each revolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

TINY = 1e-9
"""Seconds; instants closer than this are the same revolution."""


class Rotor(Protocol):
    """Revolutions are counted by an index; ``t_mono`` of step 0 rises with it."""

    def index_after(self, t_mono: float) -> int:
        """Index of the first revolution that begins at ``t_mono`` or later."""
        ...

    def start_of(self, index: int) -> float | None:
        """``t_mono`` at which the revolution passes step 0; None when there is no such revolution any more."""
        ...

    def period(self) -> float:
        """Seconds a turn takes now."""
        ...

    def set_period(self, t_mono: float, period_s: float) -> None:
        """Turn at another speed from the revolution after ``t_mono`` on."""
        ...


class EvenRotor:
    """A motor at constant speed: revolution k begins at ``t_mono + k * period_s``, without accumulating rounding."""

    def __init__(self, t_mono: float, period_s: float) -> None:
        self._t_mono, self._index, self._period = t_mono, 0, period_s

    def index_after(self, t_mono: float) -> int:
        """See :class:`Rotor`."""
        return self._index + math.ceil((t_mono - self._t_mono - TINY) / self._period)

    def start_of(self, index: int) -> float | None:
        """See :class:`Rotor`."""
        return self._t_mono + (index - self._index) * self._period

    def period(self) -> float:
        """See :class:`Rotor`."""
        return self._period

    def set_period(self, t_mono: float, period_s: float) -> None:
        """See :class:`Rotor`."""
        index = self.index_after(t_mono)
        self._t_mono += (index - self._index) * self._period
        self._index, self._period = index, period_s


class TimetableRotor:
    """Revolutions at given instants, so that a recorded log keeps its own uneven rhythm; then no more.

    Args:
        starts: rising ``t_mono`` of step 0. period_s: time a turn takes, for the spread of beams and the latency.
    """

    def __init__(self, starts: Sequence[float], period_s: float) -> None:
        self._starts = np.asarray(starts, dtype=np.float64)
        if self._starts.size and np.any(np.diff(self._starts) <= 0):
            raise ValueError("the times of a timetable must rise")
        self._period = period_s

    def index_after(self, t_mono: float) -> int:
        """See :class:`Rotor`."""
        return int(np.searchsorted(self._starts, t_mono - TINY))

    def start_of(self, index: int) -> float | None:
        """See :class:`Rotor`."""
        return float(self._starts[index]) if 0 <= index < self._starts.size else None

    def period(self) -> float:
        """See :class:`Rotor`."""
        return self._period

    def set_period(self, t_mono: float, period_s: float) -> None:
        """A timetable keeps its instants; only the spread of the beams changes."""
        self._period = period_s
