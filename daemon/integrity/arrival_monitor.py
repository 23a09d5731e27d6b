"""Arrival monitor of odometry: whether readings arrive, and at their usual rate."""

from __future__ import annotations

from collections import deque
from typing import Final

ODOMETRY_SILENT_S: Final = 1.0
"""Odometry that has not arrived for this long is silent."""
WINDOW_S: Final = 2.0
ENOUGH: Final = 20
"""Readings that a rate is judged by."""
READINGS: Final = 2560
"""Readings whose arrival is kept: of a window and more at 1 kHz."""
FEWER: Final = 0.6
"""Part of the usual rate of readings below which they come more seldom than before."""
LEAST_HZ: Final = 10.0
"""Rate of readings that is asked for; less will do for a lidar that turns more slowly."""
LEARNING: Final = 0.03
"""Weight of a window of readings in the usual rate: what lasts for a minute has become usual."""


class Arrivals:
    """Told of each reading as it arrives: with a slow lidar readings wait for a second and more for their cycle."""

    def __init__(self) -> None:
        self._at: deque[float] = deque(maxlen=READINGS)
        self._usual_hz = 0.0
        self._t_learned = 0.0

    @property
    def latest(self) -> float | None:
        """When the latest one arrived; None: none has."""
        return self._at[-1] if self._at else None

    def on_reading(self, t_rx: float) -> None:
        """A reading has arrived; what came before a silence says nothing of the rate now."""
        if self._at and t_rx - self._at[-1] > ODOMETRY_SILENT_S:
            self._at.clear()
        self._at.append(t_rx)

    def seldom(self, t_mono: float, period: float) -> bool:
        """Whether readings come more seldom than they used to, or than is required; learns the usual rate on the way.

        The rate is learned once in half a window at most, however often this is called. The required rate goes by the
        lidar only where that is slow: wheels at 20 Hz are no fault with scans at 40 Hz.
        """
        window = max(WINDOW_S, ENOUGH / self._usual_hz if self._usual_hz else 0.0)
        recent = sum(t_mono - t <= window for t in self._at)
        if not recent or t_mono - self._at[0] < window or window > 10.0 * WINDOW_S:
            return False
        hz = recent / window
        if self._usual_hz == 0.0:
            self._usual_hz = hz
        elif t_mono - self._t_learned >= 0.5 * window:
            self._usual_hz += LEARNING * (hz - self._usual_hz)
            self._t_learned = t_mono
        return hz < FEWER * max(self._usual_hz, min(LEAST_HZ, 1.0 / period))
