"""When it was, by this computer's clock, what another computer has stamped.

On a busy computer a message is under way for long, and a robot at 0.6 m/s drives on 6 mm in 10 ms.
"""

from collections import deque
from typing import Final

READS: Final = 300
"""A minute at 5 Hz: two clocks do not drift apart by much in that time."""
LATE_S: Final = 5.0
"""No message is under way for longer than another: it comes from a clock that has been set to zero meanwhile."""


class OtherClock:
    """Its monotonic clock by this one's: the message tells that was under way, or lay there unread, the shortest."""

    def __init__(self) -> None:
        self._apart: deque[float] = deque(maxlen=READS)

    def here(self, t_there: float, sent_there: float, now: float) -> float:
        """An instant of a message that was sent ``sent_there`` and came ``now``."""
        apart = now - sent_there
        if self._apart and apart > min(self._apart) + LATE_S:  # switched on anew, or it has stood still
            self._apart.clear()
        self._apart.append(apart)
        return t_there + min(self._apart)
