"""Arrival monitor of odometry: whether readings arrive, and at their usual rate."""

from __future__ import annotations

from collections import deque
from typing import Final

ODOMETRY_SILENT_S: Final = 1.0
"""Time in s without a reading after which odometry has timed out."""
WINDOW_S: Final = 2.0
ENOUGH: Final = 20
"""Number of readings from which a rate is computed."""
READINGS: Final = 2560
"""Number of arrival times that are kept: more than one window at 1 kHz."""
FEWER: Final = 0.6
"""Share of the usual rate below which the rate counts as reduced."""
LEAST_HZ: Final = 10.0
"""Largest rate that is required, Hz; a lidar with a longer scan period requires less."""
LEARNING: Final = 0.03
"""Weight of one window in the usual rate: a rate that lasts for a minute has become the usual one."""


class Arrivals:
    """Arrival times of readings, registered at arrival.

    With a slow lidar, readings wait a second and more for their cycle.
    """

    def __init__(self) -> None:
        self._at: deque[float] = deque(maxlen=READINGS)
        self._usual_hz = 0.0
        self._t_learned = 0.0

    @property
    def latest(self) -> float | None:
        """Time of the latest arrival; None before the first."""
        return self._at[-1] if self._at else None

    def on_reading(self, t_rx: float) -> None:
        """Register an arrival.

        After a timeout the window is cleared, because older readings do not represent the present rate.
        """
        if self._at and t_rx - self._at[-1] > ODOMETRY_SILENT_S:
            self._at.clear()
        self._at.append(t_rx)

    def seldom(self, t_mono: float, period: float) -> bool:
        """Whether readings arrive below their usual or the required rate; updates the usual rate.

        The usual rate is updated once in half a window at most, at any rate of calls. The required rate follows the
        lidar only where that is slow: odometry at 20 Hz is no fault with scans at 40 Hz.
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
