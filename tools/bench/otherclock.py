"""When it was, by this computer's clock, what another computer has stamped.

On a busy computer a message is under way for long, and a robot at 0.6 m/s drives on 6 mm in 10 ms.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

READS: Final = 300
"""A minute at 5 Hz: two clocks do not drift apart by much in that time."""


class OtherClock:
    """Its monotonic clock by this one's: the message tells that was under way, or lay there unread, the shortest."""

    def __init__(self) -> None:
        self._apart: deque[float] = deque(maxlen=READS)
        self._latest = -math.inf

    def here(self, t_there: float, sent_there: float, now: float) -> float:
        """An instant of a message that was sent ``sent_there`` and came ``now``."""
        if sent_there < self._latest:  # it has been switched on anew
            self._apart.clear()
        self._latest = sent_there
        self._apart.append(now - sent_there)
        return t_there + min(self._apart)
