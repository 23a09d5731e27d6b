"""Turns a cycle's time budget into caps, from measured time per iteration; nothing below the cycle reads a clock.

Order of degradation when time is short: first map work waits, then the scan is thinned, last the iterations are cut.
Map work is never put off for good.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final, Protocol

from estimator.records import UNLIMITED, Limits
from estimator.result import StepResult

ENOUGH_ITERATIONS: Final = 12
"""Iterations that a match hardly ever exceeds; thinning the scan starts where these do not fit any more."""
FEWEST_ITERATIONS: Final = 3
FEWEST_POINTS: Final = 120
LONGEST_MAP_WAIT: Final = 5
"""Cycles in a row that may put off map work."""
MEDIAN_OF: Final = 5
"""Measurements whose median counts: one step during which another process ran says nothing about the cost."""
FORGETTING: Final = 0.1
"""Weight of a measurement when costs fall; a rise counts at once."""

PLAIN_AGO: Final = 20
"""Steps with light in a row after which they teach what an iteration costs: with a slow laser there are no others."""

SEARCH_US: Final = 1000.0
SEARCH_SHARE: Final = 0.1
"""The search for further lamps gets so long, and no more than this share of the budget: it may take many cycles."""
FEWEST_CODES: Final = 4


class Budget(Protocol):
    """Says before each step what it may do, and learns afterwards what it cost."""

    def limits(self, budget_us: float, light: bool = False) -> Limits:
        """Caps for a step that may take ``budget_us`` microseconds. ``light``: a block of light samples is among it."""
        ...

    def learn(self, step_us: float, limits: Limits, result: StepResult, light: bool = False) -> None:
        """Take in what the step under these caps has cost."""
        ...

    def learn_code(self, code_us: float) -> None:
        """Take in what the search for one light code costs, microseconds."""
        ...


class FixedBudget:
    """The same caps every time: replay of a foreign log, where time does not count."""

    def __init__(self, limits: Limits = UNLIMITED) -> None:
        self._limits = limits

    def limits(self, budget_us: float, light: bool = False) -> Limits:
        """The caps given at construction."""
        return self._limits

    def learn(self, step_us: float, limits: Limits, result: StepResult, light: bool = False) -> None:
        """Nothing to learn."""

    def learn_code(self, code_us: float) -> None:
        """Nothing to learn."""


class RecordedBudget:
    """The caps of a recorded run, one cycle after the other."""

    def __init__(self, recorded: Iterable[Limits]) -> None:
        self._recorded: Iterator[Limits] = iter(recorded)

    def limits(self, budget_us: float, light: bool = False) -> Limits:
        """The next cycle's caps.

        Raises:
            LookupError: more steps than were recorded.
        """
        limits = next(self._recorded, None)
        if limits is None:
            raise LookupError("the replay makes more steps than were recorded")
        return limits

    def learn(self, step_us: float, limits: Limits, result: StepResult, light: bool = False) -> None:
        """Nothing to learn."""

    def learn_code(self, code_us: float) -> None:
        """Nothing to learn."""


class MeasuredBudget:
    """Real time: cost per iteration and point, of map work, and of light, tracked from cycle to cycle.

    To decode a block of light samples takes longer than to match a scan. It is taken from the budget of the steps that
    have one, and is no part of an iteration's cost: else scans would be thinned for the light's sake.
    """

    def __init__(self) -> None:
        self._iteration_us = 0.0
        self._map_us = 0.0
        self._code_us = 0.0
        self._iteration_costs: deque[float] = deque(maxlen=MEDIAN_OF)
        self._map_costs: deque[float] = deque(maxlen=MEDIAN_OF)
        self._queries = 0
        self._waited = 0
        self._light_us = 0.0
        self._light_costs: deque[float] = deque(maxlen=MEDIAN_OF)
        self._plain_ago = 0

    def limits(self, budget_us: float, light: bool = False) -> Limits:
        """Caps for a step that may take ``budget_us`` microseconds; uncapped matching until something was measured."""
        codes = self._codes(budget_us)
        if self._iteration_us <= 0.0:
            return replace(UNLIMITED, codes=codes)
        if self._apart(light):
            budget_us -= self._light_us
        matching_us = ENOUGH_ITERATIONS * self._iteration_us
        update_map = matching_us + self._map_us <= budget_us or self._waited >= LONGEST_MAP_WAIT
        points = UNLIMITED.points
        if matching_us > budget_us:
            points = max(FEWEST_POINTS, int(self._queries * budget_us / matching_us))
        per_iteration = self._iteration_us * min(1.0, points / max(1, self._queries))
        iterations = math.floor(budget_us / per_iteration)
        return Limits(min(UNLIMITED.icp_iterations, max(FEWEST_ITERATIONS, iterations)), points, update_map, codes)

    def _codes(self, budget_us: float) -> int:
        if self._code_us <= 0.0:
            return UNLIMITED.codes
        affordable = math.floor(min(SEARCH_US, SEARCH_SHARE * budget_us) / self._code_us)
        return min(UNLIMITED.codes, max(FEWEST_CODES, affordable))

    def learn_code(self, code_us: float) -> None:
        """Take in what the search for one light code costs."""
        self._code_us = code_us

    def learn(self, step_us: float, limits: Limits, result: StepResult, light: bool = False) -> None:
        """Take in one step. Steps without a match teach nothing about iterations."""
        self._waited = 0 if limits.update_map else self._waited + 1
        match = result.match
        if match is None or match.iterations == 0 or match.queries == 0:
            return
        self._plain_ago = self._plain_ago + 1 if light else 0
        apart = self._apart(light)
        if apart and self._iteration_us <= 0.0:
            return
        part = match.queries / max(match.queries, self._queries)
        beside_us = max(0.0, step_us - match.iterations * self._iteration_us * part)
        if result.keyframe >= 0:
            self._map_costs.append(max(0.0, beside_us - (self._light_us if apart else 0.0)))
            self._map_us = _follow(self._map_us, _median(self._map_costs))
            return
        if apart:
            self._light_costs.append(beside_us)
            self._light_us = _follow(self._light_us, _median(self._light_costs))
            return
        # cost grows with the points; it is kept for the fullest scan seen lately, so that a thinned one teaches too
        self._queries = max(match.queries, int(0.999 * self._queries))
        self._iteration_costs.append(step_us / match.iterations * (self._queries / match.queries))
        self._iteration_us = _follow(self._iteration_us, _median(self._iteration_costs))

    def _apart(self, light: bool) -> bool:
        """Whether this step's light can be told from its iterations: by steps without."""
        return light and self._plain_ago <= PLAIN_AGO


def _median(values: Iterable[float]) -> float:
    ordered = sorted(values)
    return ordered[len(ordered) // 2]


def _follow(known: float, measured: float) -> float:
    """Up at once, down slowly: a cap that is too tight costs less than an overrun."""
    return measured if measured >= known else known + FORGETTING * (measured - known)
