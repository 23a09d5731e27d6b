"""When a reading of another computer was true: its own clock tells which readings the network has held up."""

from __future__ import annotations

import math
from typing import Final

from hal.net.rx_timestamp import MAX_AGE_S

FEWEST: Final = 20
"""Readings of which it is learned how long is usual between two; before, none is dated back."""
LEARN: Final = 1.0 / FEWEST
"""Share of every later one in that."""
GAP: Final = 1.5
"""So many times the usual time between two arrivals is a gap."""
REGULAR: Final = 0.5
"""What the sender's clock has to have gone on by meanwhile, of that time, to be believed: it may have stood."""
LASTS_S: Final = 0.3
"""What still lags so long after a gap is the way of the data, or the clock."""


class SenderClock:
    """Follows one sender: arrivals, and the time that its clock gives with each reading.

    Where nothing comes for longer than usual though the clock has gone on as usual, the reading that comes at last has
    been held up by the difference, and those that come with it by less each. That much they are dated back; all others
    are as old as their arrival says. No clock has to be right for that, or fine: only what it does during a gap counts.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Another sender, or another clock."""
        self._t = self._t_gap = -math.inf
        self._time = -math.inf
        self._held = self._usual = 0.0
        self._count = 0

    def when(self, time: float, t_rx: float) -> float:
        """The instant of a reading on this computer's clock, s: ``t_rx`` at the latest, `MAX_AGE_S` before at most.

        Unless arrivals go back it is never before that of the reading before.

        Args:
            time: of the reading by the sender's clock, s, finite.
            t_rx: of its arrival, on this computer's, s; how long was waited since counts from the latest so far.
        """
        if time <= self._time:
            self.restart()
        arrived = max(t_rx, self._t)
        if self._count:
            self._follow(arrived - self._t, time - self._time, arrived)
        self._t, self._time, self._count = arrived, time, self._count + 1
        return min(t_rx, arrived - min(self._held, MAX_AGE_S))

    def _follow(self, waited: float, went_on: float, arrived: float) -> None:
        later = waited - went_on
        regular = self._count >= FEWEST and went_on >= REGULAR * self._usual
        if later > 0.0 and regular and waited > GAP * self._usual:
            self._held, self._t_gap = self._held + later, arrived
        else:
            self._held = max(0.0, self._held + min(later, 0.0))
        if arrived - self._t_gap > LASTS_S:
            self._held = 0.0
        most = waited if self._count < FEWEST else min(waited, 4.0 * self._usual)  # a silence is not what is usual
        self._usual += (most - self._usual) * max(LEARN, 1.0 / self._count)
