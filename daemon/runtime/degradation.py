"""Degradation of cycles: down at once where the work does not fit, up one level at a time once it has long fitted.

The order is fixed: fewer iterations and points, then no map work, then no laser. Costs swing from cycle to cycle; what
is left out does not, or state and reason would flicker with it.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from estimator import DegradationLevel

PATIENCE: Final = 20
"""Cycles in a row that must fit a better level before it is taken."""
LONGEST: Final = 640
"""The patience of a degradation that has had to come down again and again: half a minute of cycles with light."""
RECENT: Final = 8
MANY: Final = 3
"""So many overruns of the latest cycles say that the costs as known are not the whole truth."""


class Degradation:
    """One for cycles with light and one for those without: they cost differently.

    Attributes:
        level: the present one.
    """

    def __init__(self) -> None:
        self.level = DegradationLevel.FULL
        self._patience = PATIENCE
        self._fitted = 0
        self._recent: deque[bool] = deque(maxlen=RECENT)

    def choose(self, fits: DegradationLevel) -> DegradationLevel:
        """The level for a cycle, given the best one that its costs allow."""
        if fits >= self.level:
            self.level, self._fitted = fits, 0
            return self.level
        self._fitted += 1
        if self._fitted >= self._patience:
            self.level, self._fitted = DegradationLevel(self.level - 1), 0
            self._patience = max(PATIENCE, self._patience // 2)
        return self.level

    def ended(self, overran: bool, helps: bool) -> None:
        """Take in how a cycle ended. ``helps``: the next level would leave out something that takes long."""
        self._recent.append(overran)
        if sum(self._recent) < MANY:
            return
        self._recent.clear()
        if helps and self.level < DegradationLevel.CARRIED:
            self.level, self._fitted = DegradationLevel(self.level + 1), 0
            self._patience = min(LONGEST, 2 * self._patience)
