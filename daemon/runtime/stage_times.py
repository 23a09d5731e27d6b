"""Stage times of a cycle in us, their quantiles over the last minute, and the stage of a stall."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from daemon.runtime.histogram import HALF_S, Histogram
from daemon.snapshot import CycleTiming, Stage
from estimator import DegradationLevel

NAMES: Final = {stage.name.lower(): stage for stage in Stage}
REFRESH_S: Final = 1.0
"""Interval between updates of the quantiles, s."""


class StageTimer:
    """Stage times of the running cycle by name, us; empty without a stopwatch."""

    def __init__(self, stopwatch: Callable[[], float] | None) -> None:
        self.us: dict[str, int] = {}
        self._stopwatch = stopwatch
        self._last = 0.0

    @property
    def measures(self) -> bool:
        """True if there is a stopwatch."""
        return self._stopwatch is not None

    def begin(self) -> None:
        """Starts the timing of a cycle."""
        self.us = {}
        if self._stopwatch is not None:
            self._last = self._stopwatch()

    def lap(self, stage: str) -> None:
        """Adds the time since the last call to this stage."""
        if self._stopwatch is None:
            return
        now = self._stopwatch()
        self.us[stage] = self.us.get(stage, 0) + round((now - self._last) * 1e6)
        self._last = now

    def longest(self) -> Stage:
        """Returns the stage with the largest time."""
        return NAMES.get(max(self.us, key=self.us.__getitem__), Stage.STEP) if self.us else Stage.OUTSIDE


class TimingStatistics:
    """Counts degradation levels and stalls, keeps stage-time histograms, and publishes a :class:`CycleTiming`.

    Attributes:
        short: cycles that skipped map work or the lidar for lack of time.
    """

    def __init__(self) -> None:
        self.short = 0
        self.latest = CycleTiming()
        self._cycle, self._late = Histogram(), Histogram()
        self._stages = {name: Histogram() for name, stage in NAMES.items() if stage is not Stage.OUTSIDE}
        self._refresh = self._turn = 0.0

    def late(self, seconds: float) -> None:
        """Counts the start delay of a cycle, s."""
        self._late.add(max(0, round(seconds * 1e6)))

    def on_level(self, level: int, paused: bool = False) -> None:
        """Counts a step at this level."""
        pulse = self.latest
        self.short += level >= DegradationLevel.NO_MAP and not paused
        if level == DegradationLevel.FULL and pulse.rung == DegradationLevel.FULL:
            return
        self.latest = replace(
            pulse,
            rung=level,
            thinned=pulse.thinned + (level == DegradationLevel.THINNED),
            without_map=pulse.without_map + (level == DegradationLevel.NO_MAP),
            carried=pulse.carried + (level >= DegradationLevel.CARRIED),
        )

    def stalled(self, seconds: float, where: Stage) -> None:
        """Counts a stall: no cycle began for ``seconds``."""
        self.latest = replace(self.latest, stalls=self.latest.stalls + 1, stall_s=seconds, stall_in=where)

    def on_cycle(self, t_mono: float, us: dict[str, int]) -> None:
        """Adds the stage times of a finished cycle."""
        if not us:
            return
        self._cycle.add(sum(us.values()))
        for name, took in us.items():
            self._stages[name].add(took)
        if t_mono >= self._refresh:
            self._refresh = t_mono + REFRESH_S
            stages = tuple([histogram.spread() for histogram in self._stages.values()])
            self.latest = replace(self.latest, cycle=self._cycle.spread(), late=self._late.spread(), stages=stages)
        if t_mono >= self._turn:
            self._turn = t_mono + HALF_S
            for histogram in (self._cycle, self._late, *self._stages.values()):
                histogram.turn()
