"""Gain consistency monitor: squared normalised deviation of estimated lamp gains and tilts from their prior.

A large value means that the pose is probably wrong. Light reflected by a wall fits a wrong pose, several sigmas off,
with improbable lamps. So does the light of two lamps whose codes were exchanged. For a while, so does a lamp that fades
out. `light_inflation` derives the inflation of the light pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

KEPT_M, KEPT_S = 0.7, 60.0
"""Path length (m) and time (s) over which a value fades by a factor of e. They are those over which the error of the
light model stays the same (docs/estimator.md). Lamps in use change from epoch to epoch, the position does not.
"""
FOUND_M = 2.5
"""Path length (m) with a lamp in use over which its deviation becomes its usual one."""
EPOCH_M, EPOCH_S = 0.1, 1.0
"""Limits of one epoch (m, s): before an interval without light, deviations are neither learned nor do they fade."""
START_M = 2.0
"""Path length (m) after a start during which usual deviations are not learned. A start half a metre off finds lamp
gains that fit it before it finds its error.
"""
USUAL, VARIES, FOUND_MOST = 1.0, 1.5, 4.0
"""Deviation that is usual if nothing is wrong; factor on the long-term deviation; largest long-term deviation allowed,
in the mean of the lamps. Above it each lamp is off by two sigmas: an earlier run, the survey or the pose is wrong.
"""
WORST = 100.0
"""Cap of the value of a lamp, also used for values that are not finite."""


@dataclass(slots=True, eq=False)
class Known:
    """Usual deviation of one lamp: ``found``, squared deviations; ``way``: path length of its last use, m."""

    found: float
    way: float


@dataclass(slots=True, eq=False)
class Bent:
    """Gain consistency of all lamps since the start of the position search.

    A wrong pose has found gains that fit it alone.

    Attributes:
        now: present or recent value of the lamps in use; squared deviations, mean of the lamps. It is 0.2 to 1 where
            the light model holds.
        found: their long-term value. lamps: by lamp ID.
        begun: path length of the first use, m. t, way: instant (s) and path length (m) of the last use.
    """

    now: float = 0.0
    found: float = 0.0
    begun: float = math.inf
    t: float = math.inf
    way: float = math.inf
    lamps: dict[int, Known] = field(default_factory=dict)

    def take(self, squares: Mapping[int, float], t: float, way: float) -> None:
        """Update with the values of the lamps in use.

        Args:
            squares: by lamp ID, deviations squared; not empty.
            t: instant, s.
            way: path length, m.
        """
        self.begun = min(self.begun, way)
        told = {lamp: min(square, WORST) if math.isfinite(square) else WORST for lamp, square in squares.items()}
        step = min(max(way - self.way, 0.0), EPOCH_M)
        keep = math.exp(-step / KEPT_M - min(max(t - self.t, 0.0), EPOCH_S) / KEPT_S)
        found = [self._find(lamp, square, way) for lamp, square in told.items()]
        self.now = max(sum(told.values()) / len(told), keep * self.now)
        self.found = max(sum(found) / len(found), keep * self.found)
        self.t, self.way = t, way

    def _find(self, lamp: int, square: float, way: float) -> float:
        """Update and return the long-term value of one lamp."""
        one = self.lamps.setdefault(lamp, Known(self.found, way))  # initial value: that of the other lamps
        if way - self.begun > START_M:
            one.found += (square - one.found) * -math.expm1(-min(max(way - one.way, 0.0), EPOCH_M) / FOUND_M)
        one.way = way
        return one.found

    def elsewhere(self) -> None:
        """Clear the long-term values, because the pose is another or in doubt. The recent value stays."""
        self.lamps.clear()
        self.found, self.begun = 0.0, math.inf

    @property
    def anew(self) -> float:
        """Excess of the present value over the long-term value (limited) and over the usual value."""
        return max(0.0, self.now - max(min(VARIES * self.found, FOUND_MOST), USUAL))
