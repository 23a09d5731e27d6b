"""Wall and processor time per stage of a cycle, taken by wrapping the functions that are the stages."""

import functools
import resource
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WALL, CPU = 0, 1
QUANTILES: Final = (("median", 50.0), ("p99", 99.0), ("p99.9", 99.9), ("max", 100.0))


class Stages:
    """One row per cycle: microseconds of each stage (NaN: did not run), of all of it, and how often it was interrupted.

    A stage that runs inside another one is taken out of the outer one's time.
    """

    def __init__(self, names: tuple[str, ...], cycles: int) -> None:
        self.names = names
        self.us = np.full((2, len(names) + 1, cycles), np.nan)
        self.interrupted = np.zeros(cycles, dtype=bool)
        self.cycle = -1
        self._running: list[list[float]] = []
        self._undo: list[tuple[Any, str, Any]] = []

    def wrap(self, owner: Any, attribute: str, stage: str) -> None:
        """Time every call of ``owner.attribute`` as part of a stage."""
        function, row = getattr(owner, attribute), self.names.index(stage)

        @functools.wraps(function)
        def timed(*args: Any, **more: Any) -> Any:
            return self._timed(row, functools.partial(function, *args, **more))

        self._undo.append((owner, attribute, function))
        setattr(owner, attribute, timed)

    def unwrap(self) -> None:
        """Put everything back."""
        for owner, attribute, function in reversed(self._undo):
            setattr(owner, attribute, function)
        self._undo.clear()

    def run(self, cycle: Callable[[], object]) -> None:
        """Time one whole cycle."""
        self.cycle += 1
        before = resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw
        self._timed(len(self.names), cycle)
        self.interrupted[self.cycle] = resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw != before

    def _timed(self, row: int, call: Callable[[], object]) -> object:
        self._running.append([0.0, 0.0])
        wall, cpu = time.perf_counter(), time.thread_time()
        try:
            return call()
        finally:
            took = time.perf_counter() - wall, time.thread_time() - cpu
            inside = self._running.pop()
            whole = row == len(self.names)
            for kind in (WALL, CPU):
                own = took[kind] - (0.0 if whole else inside[kind])
                old = self.us[kind, row, self.cycle]
                self.us[kind, row, self.cycle] = 1e6 * own + (0.0 if np.isnan(old) else old)
                if self._running:
                    self._running[-1][kind] += took[kind]

    def of(self, stage: str, kind: int) -> Array:
        """(cycles,) microseconds of one stage; ``cycle`` is the whole."""
        return np.asarray(self.us[kind, len(self.names) if stage == "cycle" else self.names.index(stage)])


def quantiles(us: Array) -> dict[str, float]:
    """Median, p99, p99.9 and maximum, of the cycles in which there was something."""
    there = us[np.isfinite(us)]
    return {name: float(np.percentile(there, q)) if len(there) else float("nan") for name, q in QUANTILES}
