"""The rotating mirror of the fake sensor: the times at which it passes step 0 of each revolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

TINY = 1e-9
"""Seconds; times closer than this are the same revolution."""


class Rotor(Protocol):
    """Revolutions, numbered by an index; ``t_mono`` of step 0 increases with it."""

    def index_after(self, t_mono: float) -> int:
        """Index of the first revolution that begins at ``t_mono`` or later."""
        ...

    def start_of(self, index: int) -> float | None:
        """``t_mono`` at which the revolution passes step 0; None where it does not exist."""
        ...

    def period_of(self, index: int) -> float:
        """Duration of a revolution, s."""
        ...

    def set_period(self, t_mono: float, period_s: float) -> None:
        """Change the period from the first revolution after ``t_mono``."""
        ...


class _Run(NamedTuple):
    first: int
    t_mono: float
    period_s: float


class EvenRotor:
    """A motor at constant speed: revolution k begins at ``t_mono + k * period_s``, without accumulating rounding."""

    def __init__(self, t_mono: float, period_s: float) -> None:
        self._runs = [_Run(0, t_mono, period_s)]

    def index_after(self, t_mono: float) -> int:
        """See :class:`Rotor`."""
        for run in reversed(self._runs):
            index = run.first + math.ceil((t_mono - run.t_mono - TINY) / run.period_s)
            if index >= run.first:
                return index
        return 0

    def start_of(self, index: int) -> float | None:
        """See :class:`Rotor`."""
        run = self._run(index)
        return None if index < 0 else run.t_mono + (index - run.first) * run.period_s

    def period_of(self, index: int) -> float:
        """See :class:`Rotor`."""
        return self._run(index).period_s

    def set_period(self, t_mono: float, period_s: float) -> None:
        """See :class:`Rotor`."""
        index = max(self.index_after(t_mono), self._runs[-1].first)
        last = self._run(index)
        t_start = last.t_mono + (index - last.first) * last.period_s
        self._runs = [*self._runs[-1:], _Run(index, t_start, period_s)]

    def _run(self, index: int) -> _Run:
        return next((run for run in reversed(self._runs) if index >= run.first), self._runs[0])


class TimetableRotor:
    """Revolutions at given times, for a recorded log with its own uneven rhythm; none after the last.

    Args:
        starts: increasing ``t_mono`` of step 0.
        period_s: duration of a revolution, for the times of its beams and of its completion.
    """

    def __init__(self, starts: Sequence[float], period_s: float) -> None:
        self._starts = np.asarray(starts, dtype=np.float64)
        if self._starts.size and np.any(np.diff(self._starts) <= 0):
            raise ValueError("the times of a timetable must rise")
        self._period_s = period_s

    def index_after(self, t_mono: float) -> int:
        """See :class:`Rotor`."""
        return int(np.searchsorted(self._starts, t_mono - TINY))

    def start_of(self, index: int) -> float | None:
        """See :class:`Rotor`."""
        return float(self._starts[index]) if 0 <= index < self._starts.size else None

    def period_of(self, index: int) -> float:
        """See :class:`Rotor`."""
        return self._period_s

    def set_period(self, t_mono: float, period_s: float) -> None:
        """Change the times of the beams; the start times stay."""
        self._period_s = period_s
