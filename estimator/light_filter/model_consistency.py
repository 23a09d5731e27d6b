"""How far lamps have to be taken for others than was expected, for their light to fit where the robot is said to be.

Light that has come by way of a wall fits as well as any, with lamps that are unlikely, at a place that is wrong by
several of its deviations; so does that of two lamps whose codes were exchanged, and, for a while, that of a lamp which
goes out slowly. How much the place is doubted for it: `light_inflation`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

KEPT_M, KEPT_S = 0.7, 60.0
"""Way and time over which it fades, by a factor of e, that lamps have been bent: those over which the error of the
light model stays the same (docs/estimator.md). Lamps in use change from epoch to epoch, the place does not."""
FOUND_M = 2.5
"""Way in the use of a lamp over which what it is bent by becomes what is known of it, m."""
EPOCH_M, EPOCH_S = 0.1, 1.0
"""No epoch stands for more, m and s: what was received before the dark neither is found in it nor fades."""
START_M = 2.0
"""Way over which the place is looked for, m: what lamps are bent by meanwhile is not found, for a start that is half a
metre off has found lamps that fit it before it has found its mistake."""
USUAL, VARIES, FOUND_MOST = 1.0, 1.5, 4.0
"""Up to the first lamps are bent where nothing is wrong; up to so many times what they have long been by; but however
long, not up to more than the last, in the mean of the lamps: an earlier run or the survey is wrong by two deviations
each then, or the place is."""
WORST = 100.0
"""What a lamp counts as at most, and what no number counts as."""


@dataclass(slots=True, eq=False)
class Known:
    """One lamp: ``found``: what it has long been bent by, deviations squared; ``way``: at which it was last used, m."""

    found: float
    way: float


@dataclass(slots=True, eq=False)
class Bent:
    """All lamps, since the place began to be looked for: a place that is wrong has found lamps that fit it alone.

    Attributes:
        now: how far those in use are bent, or were of late; deviations squared, mean of the lamps. Where the light
            model holds it is 0.2 to 1.
        found: have long been. lamps: by lamp ID.
        begun: way at which a lamp was first used, m. t, way: when the last was, s and m.
    """

    now: float = 0.0
    found: float = 0.0
    begun: float = math.inf
    t: float = math.inf
    way: float = math.inf
    lamps: dict[int, Known] = field(default_factory=dict)

    def take(self, squares: Mapping[int, float], t: float, way: float) -> None:
        """Note what lamps in use are bent by.

        Args:
            squares: by lamp ID, deviations squared; not empty.
            t: instant, s.
            way: driven, m.
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
        one = self.lamps.setdefault(lamp, Known(self.found, way))  # first what those beside it have been
        if way - self.begun > START_M:
            one.found += (square - one.found) * -math.expm1(-min(max(way - one.way, 0.0), EPOCH_M) / FOUND_M)
        one.way = way
        return one.found

    def elsewhere(self) -> None:
        """The place is another, or in doubt: nothing has been found there yet. What was bent of late stays."""
        self.lamps.clear()
        self.found, self.begun = 0.0, math.inf

    @property
    def anew(self) -> float:
        """By how much lamps are bent more than they have long been, or than can be found, and more than is usual."""
        return max(0.0, self.now - max(min(VARIES * self.found, FOUND_MOST), USUAL))
