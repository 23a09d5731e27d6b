"""Scan period learned from the scan stamps; a sensor with nominally 25 ms may in fact take 25.05 ms."""

from __future__ import annotations

from collections import deque
from typing import Final

from hal.lidar import RawScan

IDLE_PERIOD_S: Final = 0.1
"""Period before any lidar has reported its own, s."""
MEDIAN_OF: Final = 31
ENOUGH: Final = 5


class ScanPeriod:
    """Median time between consecutive scans, s; missing scans and stamps that run backwards do not change it.

    Where there has never been a scan, blocks of light samples set the period.
    """

    def __init__(self) -> None:
        self._nominal = IDLE_PERIOD_S
        self._steps: deque[float] = deque(maxlen=MEDIAN_OF)
        self._median = 0.0
        self._last: tuple[int, float] | None = None

    @property
    def seconds(self) -> float:
        """Period, s: learned, else nominal, else :data:`IDLE_PERIOD_S`."""
        return self._nominal if len(self._steps) < ENOUGH else self._median

    def learn(self, scan: RawScan) -> None:
        """Updates the period with the stamp of one scan."""
        if scan.geometry.period_s > 0.0:
            self._nominal = scan.geometry.period_s
        last, self._last = self._last, (scan.seq, scan.t_mono)
        if last is None or scan.seq <= last[0]:
            return
        step = (scan.t_mono - last[1]) / (scan.seq - last[0])
        if step > 0.0:
            self._steps.append(step)
            self._median = sorted(self._steps)[len(self._steps) // 2]  # read ten times a cycle

    def learn_block(self, seconds: float) -> None:
        """Sets the nominal period to the length of a block of light samples, s, until a scan arrives."""
        if self._last is None:
            self._nominal = seconds
