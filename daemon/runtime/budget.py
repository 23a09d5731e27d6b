"""Budget of a cycle: turns its computing time into caps for the estimator, from measured stage times.

Nothing below the cycle reads a clock. Degradation under lack of time (`estimator.DegradationLevel`) has a fixed order.
First iterations are cut and the scan is thinned, then map work is deferred. Last the lidar is skipped where light or
odometry can carry the pose. Neither map work nor the lidar is deferred without limit.
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
"""Iterations that a match hardly ever exceeds. Further ones belong to a multi-start and are cut first. If even these do
not fit, the scan is thinned."""
FEWEST_POINTS: Final = 120
DENSE: Final = 400
COARSE: Final = 4
"""Scans with more than :data:`DENSE` points are first matched on every fourth point, as in
`scan_matcher.MatchSettings`. That class is not imported, because the compiler comes with it; a test keeps both
equal."""
FIXED: Final = 6500
"""Cost of a match beside its iterations, in passes of one point through one iteration: cutting both saves only the
rest. Measured with Debian's Python on x86: 682 points in 5 iterations, most on every fourth point, take 82 us of the
434 us of a match; 114 points in 3 iterations take 23 of 400 us. That is 53 and 67 ns a pass, with 6600 and 5600 passes
beside. Another interpreter or processor shifts these figures. Overruns then show what is cut in vain, or too late.
"""
LONGEST_MAP_WAIT: Final = 20
"""Consecutive cycles that may defer map work: a quarter of a metre, one keyframe, at 40 Hz and 0.5 m/s."""
PROBE_EVERY: Final = 40
PROBES: Final = 3
"""Of :data:`PROBE_EVERY` cycles that skip the lidar, this many use it; they show whether there is time again."""
WORTH_IT: Final = 0.1
"""Share of the budget that a level must save before overruns select it; load by other programs is no reason."""
MEDIAN_OF: Final = 5
"""Measurements in the median; a single step during which another process ran has no effect on the cost."""
KNOWN_AFTER: Final = 3
"""Measurements until a cost is valid: the first cycles are slow, because the caches are empty."""
FORGETTING: Final = 0.1
"""Weight of a measurement when costs fall; a rise counts at once."""

SEARCH_US: Final = 1000.0
SEARCH_SHARE: Final = 0.1
"""The search for further lamps gets :data:`SEARCH_US`, but at most this share of the budget; it may take many
cycles."""
FEWEST_CODES: Final = 4


@dataclass(frozen=True, slots=True)
class Spent:
    """Measured cost of a cycle.

    Attributes:
        us: microseconds by stage. budget_us: its budget. light: the cycle had a block of light samples.
    """

    us: Mapping[str, float]
    budget_us: float
    light: bool = False


class Budget(Protocol):
    """Gives the caps before each step, and learns the cost after it."""

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """Returns the caps for a step of a cycle that may take ``budget_us`` microseconds.

        ``light``: the step has a block of light samples. ``carrier``: light or odometry can carry the pose.
        """
        ...

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Updates the costs with the measured cost of a cycle under these caps."""
        ...

    def learn_code(self, code_us: float) -> None:
        """Sets the cost of the search for one light code, microseconds."""
        ...


class FixedBudget:
    """The same caps for every step: for the replay of a third-party log, where time does not count."""

    def __init__(self, limits: Limits = UNLIMITED) -> None:
        self._limits = limits

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """Returns the caps given at construction."""
        return self._limits

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Does nothing."""

    def learn_code(self, code_us: float) -> None:
        """Does nothing."""


class RecordedBudget:
    """The caps of a recorded run, one cycle after the other."""

    def __init__(self, recorded: Iterable[Limits]) -> None:
        self._recorded: Iterator[Limits] = iter(recorded)

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """Returns the caps of the next cycle.

        Raises:
            LookupError: the replay makes more steps than were recorded.
        """
        limits = next(self._recorded, None)
        if limits is None:
            raise LookupError("the replay makes more steps than were recorded")
        return limits

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Does nothing."""

    def learn_code(self, code_us: float) -> None:
        """Does nothing."""


class MeasuredBudget:
    """Budget in real time: tracks the cost of the match, map work, light and the rest from cycle to cycle.

    The budget minus light and the rest remains for matching and the map. Cycles with light and those without have
    separate degradations. Neither kind thins its scans or defers map work because of the other.
    """

    def __init__(self) -> None:
        self._pass, self._map, self._light, self._rest = _Cost(), _Cost(), _Cost(), _Cost()
        self._code_us = 0.0
        self._queries = 0
        self._waited = 0
        self._passed = 0
        self._plain, self._lit = Degradation(), Degradation()

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        """Returns the caps for a step within ``budget_us``; no caps for matching before the first measurement."""
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
        """Returns the cost of a match of so many points, or of all available ones, microseconds."""
        return self._pass.us * (FIXED + passes(ENOUGH_ITERATIONS, min(points, self._queries)))

    def _fits(self, left_us: float, budget_us: float) -> DegradationLevel:
        """Returns the best level that fits into ``left_us`` microseconds.

        A match that does not fit is no reason to skip the lidar. Overruns are (`Degradation`), and so is a cycle that
        would take twice its budget. That is the whole scan period, so scans would be lost.
        """
        least_us = self._match_us(FEWEST_POINTS)
        if left_us >= self._match_us(self._queries) + self._map.us:
            return DegradationLevel.FULL
        if left_us >= least_us + self._map.us:
            return DegradationLevel.THINNED
        return DegradationLevel.NO_MAP if left_us + budget_us >= least_us else DegradationLevel.CARRIED

    def _pass_over(self) -> bool:
        """True if the scan is skipped. Some scans are used now and then, to detect that there is time again."""
        self._passed += 1
        return self._passed % PROBE_EVERY >= PROBES

    def _matching(self, left_us: float, with_map: bool) -> tuple[int, int]:
        """Returns iterations and points that fit: first cuts iterations beyond enough, then thins the scan."""
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
        """Sets the cost of the search for one light code, microseconds."""
        self._code_us = code_us

    def learn(self, spent: Spent, limits: Limits, result: StepResult) -> None:
        """Updates the costs with one cycle. A step without a match gives no information on the cost of a match."""
        self._waited = 0 if limits.update_map else self._waited + 1
        us = spent.us if "match" in spent.us else {**spent.us, "match": spent.us.get("step", 0.0), "step": 0.0}
        if spent.light and "lights" in us:
            self._light.learn(us["lights"])
        self._rest.learn(sum(took for stage, took in us.items() if stage not in _APART))
        match = result.match
        if match is not None and match.iterations > 0 and match.queries > 0:
            # of the fullest recent scan: thinned scans give the cost of a pass, not the points of a full scan
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
    """Returns the points that all iterations process: every fourth one of a dense scan, and all of them at the end."""
    if points <= DENSE:
        return iterations * points
    return iterations * points / COARSE + points


_APART: Final = ("lights", "match", "map")
"""Stages whose costs are tracked separately."""


class _Cost:
    """Cost estimate, us: the median of the latest measurements; it rises at once and falls slowly.

    A cap that is too tight costs less than an overrun. One step during which another process ran has no effect.
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
