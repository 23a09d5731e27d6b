"""Pace of the machine: a test that is judged against the wall clock cannot be judged where the processors are crowded.

The number of runnable threads of the whole computer is sampled while such a test runs. Only a test that has failed is
looked at: it counts as skipped, with the measured reason, if its threads had less than a third of the processors.
"""

import os
import threading
from pathlib import Path
from typing import Final

import pytest

LOADAVG: Final = Path("/proc/loadavg")
EVERY_S: Final = 0.05
CROWDED: Final = 3.0
"""Runnable threads for each processor, mean of the worst second, above which nothing is judged: the fourfold slack
of the real-time tests needs at least a third of a processor for each of their processes."""
SECOND: Final = 20
"""Samples of a second."""


class Pace:
    """Samples the runnable threads from its making to :meth:`stop`."""

    def __init__(self, processors: int | None = None, source: Path = LOADAVG) -> None:
        self._processors = processors or len(os.sched_getaffinity(0))
        self._source = source
        self._samples: list[int] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._sample, name="pace", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the sampling; idempotent."""
        self._over.set()
        self._thread.join()

    def crowded(self) -> str:
        """Why nothing can be judged; empty: the machine was fast enough, or it is not known."""
        worst = max_mean(self._samples, SECOND) / self._processors
        if worst < CROWDED:
            return ""
        return f"the machine is too busy to judge real time: {worst:.1f} runnable threads for each processor"

    def _sample(self) -> None:
        while not self._over.wait(EVERY_S):
            if (number := runnable(self._source)) is not None:
                self._samples.append(number)


def judge(report: pytest.TestReport, pace: Pace | None) -> None:
    """Turn the failure of a test of real time into a skip, if the machine was too busy; None: it is no such test."""
    reason = "" if pace is None or report.outcome != "failed" else pace.crowded()
    if reason:
        report.outcome = "skipped"
        path, line, _ = report.location
        failure = next((text for text in report.longreprtext.splitlines() if text.startswith("E ")), "")
        report.longrepr = (path, line or 0, f"Skipped: {reason}; {failure[1:].strip()[:200]}")


def runnable(source: Path = LOADAVG) -> int | None:
    """Threads of the computer that run or wait for a processor at this instant; None where that is not known."""
    try:
        return int(source.read_text().split()[3].partition("/")[0])
    except (OSError, ValueError, IndexError):
        return None


def max_mean(samples: list[int], width: int) -> float:
    """Largest mean of ``width`` neighbouring samples, of all where there are fewer; 0.0 without any."""
    width = min(width, len(samples))
    if not width:
        return 0.0
    return max(sum(samples[k : k + width]) for k in range(len(samples) - width + 1)) / width
