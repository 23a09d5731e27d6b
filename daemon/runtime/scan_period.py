"""The scan period as it really is, learned from the stamps; a nominal 25 ms sensor may well turn in 25.05."""

from __future__ import annotations

from collections import deque
from typing import Final

from hal.lidar import RawScan

IDLE_PERIOD_S: Final = 0.1
"""What is taken for the period before any lidar has said its own."""
MEDIAN_OF: Final = 31
ENOUGH: Final = 5


class ScanPeriod:
    """Median time between consecutive scans: missing revolutions and stamps that run backwards do not move it.

    Where there has never been a scan, blocks of light samples set the pace.
    """

    def __init__(self) -> None:
        self._nominal = IDLE_PERIOD_S
        self._steps: deque[float] = deque(maxlen=MEDIAN_OF)
        self._median = 0.0
        self._last: tuple[int, float] | None = None

    @property
    def seconds(self) -> float:
        """The period: learned, else nominal, else :data:`IDLE_PERIOD_S`."""
        return self._nominal if len(self._steps) < ENOUGH else self._median

    def learn(self, scan: RawScan) -> None:
        """Take in one scan's stamp."""
        if scan.geometry.period_s > 0.0:
            self._nominal = scan.geometry.period_s
        last, self._last = self._last, (scan.seq, scan.t_mono)
        if last is None or scan.seq <= last[0]:
            return
        step = (scan.t_mono - last[1]) / (scan.seq - last[0])
        if step > 0.0:
            self._steps.append(step)
            self._median = sorted(self._steps)[len(self._steps) // 2]  # asked for ten times a cycle

    def learn_block(self, seconds: float) -> None:
        """Take in the length of a block of light samples."""
        if self._last is None:
            self._nominal = seconds
