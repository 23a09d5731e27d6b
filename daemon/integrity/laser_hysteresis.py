"""Hysteresis for OVERLOADED: set when a cycle skips the lidar, cleared after N consecutive cycles that used it.

A computer that is nearly fast enough alternates between using and skipping it; state, reason and log would flicker.
"""

from __future__ import annotations

from typing import Final

TAKEN_UP: Final = 5
"""N at first: consecutive steps with the lidar that clear the flag; fewer may be trials."""
LONGEST: Final = 640
"""Upper limit of N, which doubles at each early relapse: 16 s at 40 Hz."""
CALM: Final = 2400
"""Consecutive steps with the lidar after which N returns to its first value: a minute at 40 Hz."""


class LeftOut:
    """Hysteresis of the flag; call :meth:`on_step` once a step.

    Attributes:
        told: the flag: the lidar is reported as skipped.
    """

    def __init__(self) -> None:
        self.told = False
        self._needed = TAKEN_UP
        self._used = CALM

    def on_step(self, left_out: bool) -> bool:
        """Update with one step (``left_out``: it skipped the lidar) and return the flag."""
        if not left_out:
            self._used += 1
            self.told = self.told and self._used < self._needed
            return self.told
        if not self.told:
            self._needed = TAKEN_UP if self._used >= CALM else min(LONGEST, 2 * self._needed)
        self.told, self._used = True, 0
        return True

    def clear(self) -> None:
        """Reset after a commanded pause, in which the lidar was skipped on purpose."""
        self.told, self._used, self._needed = False, CALM, TAKEN_UP
