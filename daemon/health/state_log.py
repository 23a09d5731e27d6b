"""Log lines of the published state: a few at once in an interval, then the number of changes and the last state."""

from __future__ import annotations

import logging
import math
from typing import Final

from daemon.health.journal_fields import of_state
from daemon.health.reasons import REASONS, Reason
from daemon.snapshot import State

log = logging.getLogger(__name__)

INTERVAL_S: Final = 10.0
"""Length of an interval, s; as that between two lines on stalls (`daemon.runtime.stall_watch`)."""
LINES: Final = 4
"""Largest number of lines in an interval: a start, or a loss with its search, needs no more."""


class StateLog:
    """Logs changes of state and reason. Further ones in an interval are counted; their last state is logged after it.

    Args:
        state, reason: at the start; they are not logged.
    """

    def __init__(self, state: State, reason: Reason) -> None:
        self._logged = self._latest = (state, reason)
        self._begun = -math.inf
        self._lines = self._left_out = 0

    def on_cycle(self, t_mono: float, state: State, reason: Reason) -> None:
        """Receive the state of a cycle at ``t_mono`` (s); call it in every cycle."""
        present = state, reason
        before, self._latest = self._latest, present
        if present != before and self._waits(t_mono):
            self._left_out += 1
        elif present != self._logged and not self._waits(t_mono):
            self._log(t_mono, state, reason)

    def _waits(self, t_mono: float) -> bool:
        """Return True if the lines of the present interval are used up."""
        return self._lines >= LINES and t_mono < self._begun + INTERVAL_S

    def _log(self, t_mono: float, state: State, reason: Reason) -> None:
        if t_mono >= self._begun + INTERVAL_S:
            self._begun, self._lines = t_mono, 0
        meaning, remedy = REASONS[reason]
        what = f" ({remedy})" if remedy else ""
        changes = f"; {self._left_out} changes since the previous line" if self._left_out > 1 else ""
        log.info("%s: %s%s%s", state.name, meaning, what, changes, extra=of_state(state.name, meaning, remedy))
        self._logged, self._left_out = (state, reason), 0
        self._lines += 1
