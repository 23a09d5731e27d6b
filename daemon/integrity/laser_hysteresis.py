"""Hysteresis for OVERLOADED: set when a cycle skips the laser, cleared after N consecutive cycles that used it.

A computer that is nearly fast enough takes it in and leaves it out by turns; state, reason and log would flicker.
"""

from __future__ import annotations

from typing import Final

TAKEN_UP: Final = 5
"""Steps in a row that take the laser in again until it is no longer said to be left out: a few are trials."""
LONGEST: Final = 640
"""The same where that has not lasted, again and again: 16 s at 40 Hz."""
CALM: Final = 2400
"""Steps with the laser after which it counts as the first time: a minute at 40 Hz."""


class LeftOut:
    """Fed once a step.

    Attributes:
        told: whether the laser is to be called left out.
    """

    def __init__(self) -> None:
        self.told = False
        self._needed = TAKEN_UP
        self._used = CALM

    def on_step(self, left_out: bool) -> bool:
        """Take in whether this step left the laser out; what is to be told of it."""
        if not left_out:
            self._used += 1
            self.told = self.told and self._used < self._needed
            return self.told
        if not self.told:
            self._needed = TAKEN_UP if self._used >= CALM else min(LONGEST, 2 * self._needed)
        self.told, self._used = True, 0
        return True

    def clear(self) -> None:
        """It was left out by order, and is not any more."""
        self.told, self._used, self._needed = False, CALM, TAKEN_UP
