"""Decides when a sensor may be rebooted: at a growing distance, and never while it starts up.

A reboot restarts the time that a sensor needs before it measures (seqsense/urg_stamped pull request 115). Reboots at a
fixed distance shorter than that time would keep the sensor from ever measuring.
"""

from __future__ import annotations

from typing import Final

from hal.errors import HalError
from hal.hokuyo.sensor_errors import AbnormalState, StartingUp

PATIENCE_S: Final = 90.0
"""From the beginning of a trouble to the first reboot, and the unit of the further distances (s)."""
ABNORMAL_S: Final = 10.0
"""The unit of the distances in the error state (0L), in which a sensor accepts RB only (s)."""
LONGEST_S: Final = 3600.0
CALM_S: Final = 300.0
"""Valid scans this long after a reboot make the next trouble a new one (s)."""


class RebootPacing:
    """Keeps the beginning of the present trouble and the reboots since then; times are ``t_mono`` in s."""

    def __init__(self) -> None:
        self._since: float | None = None
        self._rebooted = float("-inf")
        self._count = 0

    def add_failure(self, error: HalError, now: float) -> None:
        """Add one failure; a sensor that reports a start-up defers the reboot."""
        if self._since is None or isinstance(error, StartingUp):
            self._since = now

    def add_success(self, now: float) -> None:
        """The sensor delivers valid scans."""
        self._since = None
        if now - self._rebooted > CALM_S:
            self._count = 0

    def is_due(self, error: HalError, now: float) -> bool:
        """Whether a reboot is due for ``error``."""
        if isinstance(error, StartingUp):
            return False
        abnormal = isinstance(error, AbnormalState)
        if abnormal and not self._count:
            return True
        since = max(self._rebooted, now if self._since is None else self._since)
        return now - since >= min((ABNORMAL_S if abnormal else PATIENCE_S) * 2.0**self._count, LONGEST_S)

    def add_reboot(self, now: float) -> None:
        """The sensor has been rebooted."""
        self._rebooted = now
        self._count = min(self._count + 1, 16)
