"""Position alert: raised while the protection level exceeds the alert limit, or is not available."""

from __future__ import annotations

import logging
import math
from typing import Final

from daemon.integrity.evidence import Evidence
from daemon.integrity.state_machine import HELD, disagreed
from daemon.integrity.state_memory import Memory

CLEAR_S: Final = 1.0
"""Time in s within the limit after which the alert is cleared, so that it does not chatter."""
SETTLE_S: Final = 10.0
"""Time in s from the first protection level of a run in which it may fall below the limit; no alert is reported before.
"""

log = logging.getLogger(__name__)


def bounded(memory: Memory, evidence: Evidence) -> bool:
    """Whether a protection level is available: it requires a confirmed position.

    A protection level assumes that the pose is roughly right, and limits its error. It is not available during
    relocalisation, for a lost or unconfirmed pose, or when light or the latest scan contradicts it. Nor is it available
    before the heading has converged, because no covariance covers where that leads. While odometry and lidar contradict
    each other, one of them is wrong, and only light can show which.
    """
    in_doubt = memory.doubt or memory.failed > 0 or evidence.guessed or evidence.places is not None
    in_doubt = in_doubt or memory.odd_since is not None or _turning(memory, evidence)
    in_doubt = in_doubt or (disagreed(memory, evidence) and not _lit(evidence))
    return memory.state in HELD and not in_doubt


def _lit(evidence: Evidence) -> bool:
    """Whether light confirms the pose."""
    light = evidence.light
    return light is not None and light.placed and light.used and light.agrees is True


def _turning(memory: Memory, evidence: Evidence) -> bool:
    """Whether the heading in the survey has not converged yet while odometry or lidar moves the pose along it."""
    light, carried = evidence.light, evidence.lidar or evidence.odometry is not None
    return carried and light is not None and light.placed and not (light.known[2] or memory.tracked)


class Alarm:
    """Compares the protection level with the alert limit in every cycle; each change is logged once.

    Args:
        limit_m: alert limit in m, 0: no alert is ever raised.

    Attributes:
        on: the alert is raised. With a limit it is raised until the first protection level is within it: missing
            information must not look like a good state. said: it has been logged. It is not logged before the level was
            within the limit, or had the time to get there. Before the first protection level of a run, state and reason
            suffice.
    """

    def __init__(self, limit_m: float = 0.0) -> None:
        self.limit_m = limit_m
        self.on = limit_m > 0.0
        self.said = False
        self._within_since: float | None = None
        self._expected = math.inf  # `t_mono` in s by which the level should be within the limit

    def update(self, t_mono: float, bound_m: float | None) -> bool:
        """Update with one cycle's protection level in m (None: not available); return whether the alert is raised."""
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
            said = f"the protection level is {bound_m:.3g} m" if known else "there is no protection level"
            log.warning(
                "position alert: %s (alert limit `integrity.alert_m`: %.3g m). Stop or slow down, read state "
                "and reason, and drive to where the pose is known",
                said,
                self.limit_m,
            )
            self.said = True

    def _clear(self, t_mono: float, bound_m: float) -> None:
        if self.said:
            log.info(
                "position alert over: the protection level is %.3g m, the alert limit %.3g m", bound_m, self.limit_m
            )
        self.on = self.said = False
        self._expected = min(self._expected, t_mono)
