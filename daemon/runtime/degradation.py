"""How far to do without: down at once where the work does not fit, up again one rung at a time once it has long fitted.

The order is fixed: fewer iterations and points, then no map work, then no laser. Costs swing from cycle to cycle; what
is left out does not, or state and reason would flicker with it.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from estimator import Rung

PATIENCE: Final = 20
"""Cycles in a row that must fit a better rung before it is taken."""
LONGEST: Final = 640
"""The patience of a ladder that has had to come down again and again: half a minute of cycles with light."""
RECENT: Final = 8
MANY: Final = 3
"""So many overruns of the latest cycles say that the costs as known are not the whole truth."""


class Ladder:
    """One for cycles with light and one for those without: they cost differently.

    Attributes:
        rung: the present one.
    """

    def __init__(self) -> None:
        self.rung = Rung.FULL
        self._patience = PATIENCE
        self._fitted = 0
        self._recent: deque[bool] = deque(maxlen=RECENT)

    def take(self, fits: Rung) -> Rung:
        """The rung for a cycle, given the best one that its costs allow."""
        if fits >= self.rung:
            self.rung, self._fitted = fits, 0
            return self.rung
        self._fitted += 1
        if self._fitted >= self._patience:
            self.rung, self._fitted = Rung(self.rung - 1), 0
            self._patience = max(PATIENCE, self._patience // 2)
        return self.rung

    def ended(self, overran: bool, helps: bool) -> None:
        """Take in how a cycle ended. ``helps``: the next rung would leave out something that takes long."""
        self._recent.append(overran)
        if sum(self._recent) < MANY:
            return
        self._recent.clear()
        if helps and self.rung < Rung.CARRIED:
            self.rung, self._fitted = Rung(self.rung + 1), 0
            self._patience = min(LONGEST, 2 * self._patience)
