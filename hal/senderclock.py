"""When a reading of another computer was true: its own clock tells how late the network has brought it."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from hal.arrival import MAX_AGE_S

WINDOW_S: Final = 3.0
"""What the way has been like for so long: clocks drift by less than a millisecond meanwhile, and one that has been set
back is believed by then."""
FIRST_S: Final = 0.01
LEAST_S: Final = 50e-6
STEP: Final = 1.05
"""The usual lateness, to begin with and at least; with every reading it changes by this factor, so that it follows the
median, whatever a single reading does."""


class SenderClock:
    """Follows (arrival - the sender's time) of one sender; what it has never been less than is the way of the data.

    A reading that is later than twice the usual is taken to have been under way for longer, and dated back by that; all
    others are as old as their arrival says. So a clock that ticks as coarsely as readings come does no harm, nor one
    that stands, runs wild or is set: then nothing is late, or everything, and the arrival is as good as it was.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Another sender, or another clock."""
        self._least: deque[tuple[float, float]] = deque()  # (arrival, delay): falling arrivals have rising delays
        self._time = -math.inf
        self._usual = FIRST_S

    def when(self, time: float, t_rx: float) -> float:
        """The instant of a reading on this computer's clock, ``t_rx`` at the latest.

        Args:
            time: of the reading by the sender's clock, s.
            t_rx: of its arrival, on this computer's, s.
        """
        if time <= self._time:
            self.restart()
        self._time = time
        delay = t_rx - time
        while self._least and self._least[-1][1] >= delay:
            self._least.pop()
        self._least.append((t_rx, delay))
        while self._least[0][0] < t_rx - WINDOW_S:
            self._least.popleft()
        late = delay - self._least[0][1]
        allowed = 2.0 * self._usual
        self._usual = max(LEAST_S, self._usual * (STEP if late > self._usual else 1.0 / STEP))
        return t_rx - late + allowed if allowed < late <= MAX_AGE_S else t_rx
