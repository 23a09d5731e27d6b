"""The position alert: raised while the protection level exceeds the alert limit, or there is none."""

from __future__ import annotations

import logging
import math
from typing import Final

from daemon.integrity.evidence import Evidence
from daemon.integrity.state_machine import HELD
from daemon.integrity.state_memory import Memory

CLEAR_S: Final = 1.0
"""The bound has to be within the limit for this long before the alert is over: it must not chatter."""
SETTLE_S: Final = 10.0
"""From the first bound of a run on it has this long to come within the limit; an alert before that is not said."""

log = logging.getLogger(__name__)


def bounded(memory: Memory, evidence: Evidence) -> bool:
    """Whether a bound on the error of the pose can stand: the place is not in doubt.

    A bound assumes that the pose is about right and says how wrong it may be. Nothing of that kind can be said of a
    place that is being looked for, was lost, was laid upon a guess, that light contradicts or the latest scan does not
    fit; nor while a heading that is still being found may be any, for where that leads no covariance says.
    """
    in_doubt = memory.doubt or memory.failed > 0 or evidence.guessed or evidence.places is not None
    in_doubt = in_doubt or memory.odd_since is not None or _turning(memory, evidence)
    return memory.state in HELD and not in_doubt


def _turning(memory: Memory, evidence: Evidence) -> bool:
    """Whether the heading in the building is still being found from lamps, and something carries the pose by it."""
    light, carried = evidence.light, evidence.lidar or evidence.odometry is not None
    return carried and light is not None and light.placed and not (light.known[2] or memory.tracked)


class Alarm:
    """Compares the bound with the limit, cycle by cycle; what changes goes to the log, once.

    Args:
        limit_m: metres, 0: no alert is ever raised.

    Attributes:
        on: the alert is raised. With a limit it is raised until the first bound says otherwise: who knows nothing does
            not say that all is well. said: it has gone to the log: not before the bound was within the limit, or had
            the time to get there. Without any bound, as while a place is looked for, state and reason say enough.
    """

    def __init__(self, limit_m: float = 0.0) -> None:
        self.limit_m = limit_m
        self.on = limit_m > 0.0
        self.said = False
        self._within_since: float | None = None
        self._expected = math.inf  # when the bound should be within the limit: `t_mono`, seconds

    def update(self, t_mono: float, bound_m: float | None) -> bool:
        """Take one cycle's bound (None: there is none) and say whether the alert is raised."""
        if self.limit_m <= 0.0:
            return False
        if bound_m is not None:
            self._expected = min(self._expected, t_mono + SETTLE_S)
        if bound_m is None or not bound_m <= self.limit_m:
            self._within_since = None
            self._raise(t_mono, bound_m)
        else:
            self._within_since = t_mono if self._within_since is None else self._within_since
            if t_mono - self._within_since >= CLEAR_S:
                self._clear(t_mono, bound_m)
        return self.on

    def _raise(self, t_mono: float, bound_m: float | None) -> None:
        self.on = True
        if t_mono >= self._expected and not self.said:
            known = bound_m is not None and math.isfinite(bound_m)
            said = f"it may be {bound_m:.3g} m" if known else "there is no bound on it"
            log.warning(
                "alert: the position error may be above the limit of %.3g m that `integrity.alert_m` sets: %s; stop or "
                "go slow, read state and reason, and drive to where the pose is known",
                self.limit_m,
                said,
            )
            self.said = True

    def _clear(self, t_mono: float, bound_m: float) -> None:
        if self.said:
            log.info("alert over: the position error is below %.3g m, the limit is %.3g m", bound_m, self.limit_m)
        self.on = self.said = False
        self._expected = min(self._expected, t_mono)
