"""Measurement time of a remote reading: the sender's clock shows which readings the network has held up."""

from __future__ import annotations

import math
from typing import Final

from hal.net.rx_timestamp import MAX_AGE_S

FEWEST: Final = 20
"""Readings from which the usual interval is learned; before that none is dated back."""
LEARN: Final = 1.0 / FEWEST
"""Weight of each later reading in the usual interval."""
GAP: Final = 1.5
"""An arrival interval of this many usual intervals is a gap."""
REGULAR: Final = 0.5
"""Least advance of the sender's clock during a gap, in usual intervals; a smaller one means that the clock stood."""
LASTS_S: Final = 0.3
"""A lag that lasts this long after a gap is a change of the route or of the clock, not a hold-up."""


class SenderClock:
    """Arrival times and clock readings of one sender.

    A gap in the arrivals during which the sender's clock ran on as usual is a hold-up: the first reading after it is
    late by the difference, each following one by less. These readings are dated back by their lateness; all others
    keep their arrival time. The sender's clock needs neither offset nor rate: only its advance during a gap counts.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything: another sender, or another clock."""
        self._t = self._t_gap = -math.inf
        self._time = -math.inf
        self._held = self._usual = 0.0
        self._count = 0

    def measured_at(self, time: float, t_rx: float) -> float:
        """Time of a reading on this computer's clock, s: between ``t_rx - MAX_AGE_S`` and ``t_rx``.

        It never decreases as long as the arrival times do not.

        Args:
            time: the sender's clock at the reading, s, finite.
            t_rx: arrival on this computer's clock, s. Intervals count from the latest arrival so far.
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
        most = (
            waited if self._count < FEWEST else min(waited, 4.0 * self._usual)
        )  # a long silence must not stretch the usual interval
        self._usual += (most - self._usual) * max(LEARN, 1.0 / self._count)
