"""SCL timing of a message: the time of its n-th clock, with stalls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Times = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SclTiming:
    """The clocks of one message.

    Attributes:
        t_start: ``t_mono`` of START. scl_hz: clocks per second without stalls.
        stalls: (clock, seconds) at which SCL is held low.
    """

    t_start: float
    scl_hz: float
    stalls: tuple[tuple[float, float], ...] = ()

    def times(self, clocks: npt.ArrayLike) -> Times:
        """``t_mono`` of clocks, counted from START."""
        counted = np.asarray(clocks, dtype=np.float64)
        t = self.t_start + counted / self.scl_hz
        for clock, seconds in self.stalls:
            t = t + np.where(counted > clock, seconds, 0.0)
        return np.asarray(t)

    def time(self, clock: float) -> float:
        """``t_mono`` of one clock."""
        return float(self.times([clock])[0])
