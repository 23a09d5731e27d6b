"""The sensor's own clock: 24-bit milliseconds, off in rate, zeroed by resets, true only to itself."""

from __future__ import annotations

import math

WRAP = 1 << 24


class SensorClock:
    """Maps ``t_mono`` to the sensor's milliseconds.

    Args:
        t_mono: now. start_ms: what the clock shows now. gain: relative rate error, 50e-6 = 50 ppm fast.
    """

    def __init__(self, t_mono: float, start_ms: float, gain: float) -> None:
        self._t_mono = t_mono
        self._ms = start_ms
        self.gain = gain

    def ms(self, t_mono: float) -> float:
        """Unwrapped milliseconds since the last reset."""
        return self._ms + (t_mono - self._t_mono) * 1e3 * (1.0 + self.gain)

    def tick(self, t_mono: float) -> int:
        """The 24-bit stamp of an instant: whole milliseconds, cut off."""
        return math.floor(self.ms(t_mono) + 1e-7) % WRAP

    def set(self, t_mono: float, ms: float = 0.0) -> None:
        """Show ``ms`` at ``t_mono``; 0 is what RS, RT, RB and power-on do."""
        self._t_mono, self._ms = t_mono, ms

    def next_tick(self, t_mono: float, tick_s: float) -> float:
        """First ``t_mono`` not before the given one at which the clock shows a multiple of ``tick_s``."""
        if tick_s <= 0.0:
            return t_mono
        step_ms = tick_s * 1e3
        ahead = math.ceil(self.ms(t_mono) / step_ms - 1e-9) * step_ms - self.ms(t_mono)
        return t_mono + max(0.0, ahead) * 1e-3 / (1.0 + self.gain)
