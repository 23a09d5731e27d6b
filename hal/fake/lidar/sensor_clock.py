"""The sensor's clock: 24-bit milliseconds with a rate error, zeroed by resets."""

from __future__ import annotations

import math

WRAP = 1 << 24


class SensorClock:
    """Maps ``t_mono`` to the sensor's milliseconds.

    Args:
        t_mono: now. start_ms: reading of the clock now. gain: relative rate error, 50e-6 = 50 ppm fast.
    """

    def __init__(self, t_mono: float, start_ms: float, gain: float) -> None:
        self._t_mono = t_mono
        self._ms = start_ms
        self.gain = gain

    def ms(self, t_mono: float) -> float:
        """Unwrapped milliseconds since the last reset."""
        return self._ms + (t_mono - self._t_mono) * 1e3 * (1.0 + self.gain)

    def tick(self, t_mono: float) -> int:
        """The 24-bit stamp of a time: whole milliseconds, truncated."""
        return math.floor(self.ms(t_mono) + 1e-7) % WRAP

    def set(self, t_mono: float, ms: float = 0.0) -> None:
        """Set the clock to ``ms`` at ``t_mono``; RS, RT, RB and power-on set 0."""
        self._t_mono, self._ms = t_mono, ms

    def next_tick(self, t_mono: float, tick_s: float) -> float:
        """First ``t_mono`` from the given one on at which the clock is a multiple of ``tick_s``."""
        if tick_s <= 0.0:
            return t_mono
        step_ms = tick_s * 1e3
        ahead = math.ceil(self.ms(t_mono) / step_ms - 1e-9) * step_ms - self.ms(t_mono)
        return t_mono + max(0.0, ahead) * 1e-3 / (1.0 + self.gain)
