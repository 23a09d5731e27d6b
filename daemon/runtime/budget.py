"""Turns a cycle's time budget into caps, from measured times; nothing below the cycle reads a clock.

Order of degradation when time is short (`estimator.DegradationLevel`): first iterations are cut and the scan thinned,
then map work waits, last the laser is left out where light or odometry can carry the pose. Neither is put off for good.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, Protocol

from daemon.runtime.degradation import Degradation
from estimator import UNLIMITED, DegradationLevel, Limits, StepResult

ENOUGH_ITERATIONS: Final = 12
"""Iterations that a match hardly ever exceeds: more are cut first, for they are those of a second opinion; where these
do not fit, the scan is thinned."""
FEWEST_POINTS: Final = 120
DENSE: Final = 400
COARSE: Final = 4
"""Scans of more points are matched on every fourth one at first: as in `scan_matcher.MatchSettings`, which is not
imported, because the compiler comes with it (a test holds them equal)."""
FIXED: Final = 6500
"""What a match costs beside its iterations, in passes of one point through one iteration: cutting both saves only the
rest. Measured with Debian's Python on x86: 682 points in 5 iterations, most on every fourth point, take 82 us of the
434 us of a match, 114 in 3 iterations 23 of 400: 53 and 67 ns a pass, 6600 and 5600 of them beside. Another interpreter
or processor shifts that; what is then cut in vain, or too late, overruns tell."""
LONGEST_MAP_WAIT: Final = 20
"""Cycles in a row that may put off map work: a quarter of a metre, a keyframe, at 40 Hz and half a metre a second."""
PROBE_EVERY: Final = 40
PROBES: Final = 3
"""Of so many cycles that pass the scan over, so many do not: they tell whether there is time again."""
WORTH_IT: Final = 0.1
"""Share of the budget that a level must save to be taken because of overruns: what other programs take is no reason."""
MEDIAN_OF: Final = 5
"""Measurements whose median counts: one step during which another process ran says nothing about the cost."""
KNOWN_AFTER: Final = 3
"""Measurements until something is said to be known: the first cycles are slow, for nothing is in the caches yet."""
FORGETTING: Final = 0.1
"""Weight of a measurement when costs fall; a rise counts at once."""

SEARCH_US: Final = 1000.0
SEARCH_SHARE: Final = 0.1
"""The search for further lamps gets so long, and no more than this share of the budget: it may take many cycles."""
FEWEST_CODES: Final = 4


@dataclass(frozen=True, slots=True)
class Spent:
    """What a cycle has cost.

    Attributes:
        us: microseconds by stage. budget_us: what it was allowed. light: a block of light samples was among it.
    """

    us: Mapping[str, float]
    budget_us: float
    light: bool = False


class Budget(Protocol):
    """Says before each step what it may do, and learns afterwards what it cost."""

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """Caps for a step of a cycle that may take ``budget_us`` microseconds.

        ``light``: a block of light samples is among it. ``carrier``: light or odometry can carry the pose.
        """
        ...

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Take in what the cycle under these caps has cost."""
        ...

    def learn_code(self, code_us: float) -> None:
        """Take in what the search for one light code costs, microseconds."""
        ...


class FixedBudget:
    """The same caps every time: replay of a foreign log, where time does not count."""

    def __init__(self, limits: Limits = UNLIMITED) -> None:
        self._limits = limits

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """The caps given at construction."""
        return self._limits

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Nothing to learn."""

    def learn_code(self, code_us: float) -> None:
        """Nothing to learn."""


class RecordedBudget:
    """The caps of a recorded run, one cycle after the other."""

    def __init__(self, recorded: Iterable[Limits]) -> None:
        self._recorded: Iterator[Limits] = iter(recorded)

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """The next cycle's caps.

        Raises:
            LookupError: more steps than were recorded.
        """
        limits = next(self._recorded, None)
        if limits is None:
            raise LookupError("the replay makes more steps than were recorded")
        return limits

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Nothing to learn."""

    def learn_code(self, code_us: float) -> None:
        """Nothing to learn."""


class MeasuredBudget:
    """Real time: what a match, map work, light, and all the rest cost, tracked from cycle to cycle by stage.

    What is left of the budget after light and the rest is for matching and the map. Cycles with light and those without
    have a degradation each: in neither are scans thinned, or map work put off, for the sake of the other.
    """

    def __init__(self) -> None:
        self._pass, self._map, self._light, self._rest = _Cost(), _Cost(), _Cost(), _Cost()
        self._code_us = 0.0
        self._queries = 0
        self._waited = 0
        self._passed = 0
        self._plain, self._lit = Degradation(), Degradation()

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """Caps for a step of a cycle that may take ``budget_us``; none for matching until something was measured."""
        codes = self._codes(budget_us)
        if self._pass.us <= 0.0:
            return replace(UNLIMITED, codes=codes)
        left_us = budget_us - self._rest.us - (self._light.us if light else 0.0)
        level = self._degradation(light).choose(self._fits(left_us, budget_us))
        if level is DegradationLevel.CARRIED and not (carrier and self._pass_over()):
            level = DegradationLevel.NO_MAP
        update_map = level < DegradationLevel.NO_MAP or (
            level is DegradationLevel.NO_MAP and self._waited >= LONGEST_MAP_WAIT
        )
        if update_map:
            level = min(level, DegradationLevel.THINNED)
        iterations, points = self._matching(
            left_us, update_map and self._fits(left_us, budget_us) < DegradationLevel.NO_MAP
        )
        return Limits(iterations, points, update_map, codes, level)

    def _degradation(self, light: bool) -> Degradation:
        return self._lit if light else self._plain

    def _match_us(self, points: int) -> float:
        """What a match of so many points, or all there are, costs."""
        return self._pass.us * (FIXED + passes(ENOUGH_ITERATIONS, min(points, self._queries)))

    def _fits(self, left_us: float, budget_us: float) -> DegradationLevel:
        """The best level that so many microseconds allow.

        A match that does not fit is no reason to leave the laser out: overruns are (`Degradation`), or a cycle that
        would take twice its budget, which is the whole period: scans would be lost.
        """
        least_us = self._match_us(FEWEST_POINTS)
        if left_us >= self._match_us(self._queries) + self._map.us:
            return DegradationLevel.FULL
        if left_us >= least_us + self._map.us:
            return DegradationLevel.THINNED
        return DegradationLevel.NO_MAP if left_us + budget_us >= least_us else DegradationLevel.CARRIED

    def _pass_over(self) -> bool:
        """Whether a scan is passed over: now and then a few are not, or it would never be known that there is time."""
        self._passed += 1
        return self._passed % PROBE_EVERY >= PROBES

    def _matching(self, left_us: float, with_map: bool) -> tuple[int, int]:
        """Iterations and points that fit: first iterations beyond enough are cut, then the scan is thinned."""
        if with_map:
            left_us -= self._map.us
        room = max(0.0, left_us / self._pass.us - FIXED)
        points = UNLIMITED.points
        if passes(ENOUGH_ITERATIONS, self._queries) > room:
            points = max(FEWEST_POINTS, int(room / ENOUGH_ITERATIONS))
        taken = min(points, self._queries)
        iterations = math.floor((room - passes(0, taken)) / (passes(1, taken) - passes(0, taken)))
        return min(UNLIMITED.icp_iterations, max(ENOUGH_ITERATIONS, iterations)), points

    def _codes(self, budget_us: float) -> int:
        if self._code_us <= 0.0:
            return UNLIMITED.codes
        affordable = math.floor(min(SEARCH_US, SEARCH_SHARE * budget_us) / self._code_us)
        return min(UNLIMITED.codes, max(FEWEST_CODES, affordable))

    def learn_code(self, code_us: float) -> None:
        """Take in what the search for one light code costs."""
        self._code_us = code_us

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Take in one cycle. Steps without a match teach nothing about its cost."""
        self._waited = 0 if limits.update_map else self._waited + 1
        us = spent.us if "match" in spent.us else {**spent.us, "match": spent.us.get("step", 0.0), "step": 0.0}
        if spent.light and "lights" in us:
            self._light.learn(us["lights"])
        self._rest.learn(sum(took for stage, took in us.items() if stage not in _APART))
        match = result.match
        if match is not None and match.iterations > 0 and match.queries > 0:
            # of the fullest scan seen lately: thinned ones tell the cost of a pass, not how many a full one takes
            self._queries = max(match.queries, int(0.999 * self._queries))
            self._pass.learn(us.get("match", 0) / (FIXED + passes(match.iterations, match.queries)))
        if result.keyframe >= 0 and "map" in us:
            self._map.learn(us["map"])
        thinning_us = self._match_us(self._queries) - self._match_us(FEWEST_POINTS)
        mapping_us = us.get("map", 0)
        saving = {
            DegradationLevel.FULL: max(thinning_us, mapping_us),
            DegradationLevel.THINNED: mapping_us,
            DegradationLevel.NO_MAP: us.get("match", 0),
        }
        helps = saving.get(DegradationLevel(limits.level), 0) > WORTH_IT * spent.budget_us
        self._degradation(spent.light).ended(sum(us.values()) > spent.budget_us, helps)


def passes(iterations: int, points: int) -> float:
    """Points that all iterations pass through: of a dense scan every fourth one, and all of them at last."""
    if points <= DENSE:
        return iterations * points
    return iterations * points / COARSE + points


_APART: Final = ("lights", "match", "map")
"""Stages whose costs are known each for itself."""


class _Cost:
    """What something costs, by the median of the latest few: up at once, down slowly.

    A cap that is too tight costs less than an overrun; one step during which another process ran says nothing.
    """

    def __init__(self) -> None:
        self.us = 0.0
        self._latest: deque[float] = deque(maxlen=MEDIAN_OF)

    def learn(self, us: float) -> None:
        self._latest.append(us)
        if len(self._latest) < KNOWN_AFTER:
            return
        ordered = sorted(self._latest)
        measured = ordered[len(ordered) // 2]
        self.us = measured if measured >= self.us else self.us + FORGETTING * (measured - self.us)
