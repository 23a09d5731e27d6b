"""Degradation level of cycles: worse at once when the work does not fit, better by one level after it has long fitted.

The order is fixed: fewer iterations and points, then no map work, then no lidar. Costs vary from cycle to cycle. The
level must not, or state and reason would flicker with it.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from estimator import DegradationLevel

PATIENCE: Final = 20
"""Consecutive cycles that must fit a better level before it is selected."""
LONGEST: Final = 640
"""Largest patience after repeated degradations, cycles: half a minute of cycles with light."""
RECENT: Final = 8
MANY: Final = 3
"""Overruns among the latest :data:`RECENT` cycles from which the estimated costs count as incomplete."""


class Degradation:
    """One degradation for cycles with light and one for those without, because their costs differ.

    Attributes:
        level: the present one.
    """

    def __init__(self) -> None:
        self.level = DegradationLevel.FULL
        self._patience = PATIENCE
        self._fitted = 0
        self._recent: deque[bool] = deque(maxlen=RECENT)

    def choose(self, fits: DegradationLevel) -> DegradationLevel:
        """Returns the level for a cycle, given the best level that its costs permit."""
        if fits >= self.level:
            self.level, self._fitted = fits, 0
            return self.level
        self._fitted += 1
        if self._fitted >= self._patience:
            self.level, self._fitted = DegradationLevel(self.level - 1), 0
            self._patience = max(PATIENCE, self._patience // 2)
        return self.level

    def ended(self, overran: bool, helps: bool) -> None:
        """Updates the level after a cycle. ``helps``: the next level would omit work that takes long."""
        self._recent.append(overran)
        if sum(self._recent) < MANY:
            return
        self._recent.clear()
        if helps and self.level < DegradationLevel.CARRIED:
            self.level, self._fitted = DegradationLevel(self.level + 1), 0
            self._patience = min(LONGEST, 2 * self._patience)
