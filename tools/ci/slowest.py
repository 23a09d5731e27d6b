"""Slowest tests and why they are slow: a pytest plugin.

    make slowest                          # of `make test`
    make slowest ARGS="tests/daemon"

For each phase of a test (set-up, call, tear-down) it takes the wall clock, the processor time of the process and of its
ended children, and the time for which the process waited for a processor. The largest part is the reason.
"""

import os
import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Final

import pytest

from daemon.system.processor_wait import ProcessorWait

LISTED: Final = 30
KEY: Final = "slowest"
"""Name of the property that carries the figures from a worker process to the summary."""


@dataclass(frozen=True, slots=True)
class Spent:
    """What a phase took, s.

    Attributes:
        wall: by the clock. own, children: processor time of this process and of its ended children.
        starved: time for which the main thread was ready while others ran. compiled: time of the JIT compiler.
    """

    wall: float
    own: float
    children: float
    starved: float
    compiled: float

    def reason(self) -> str:
        """The largest part in words."""
        parts = {
            "compiles kernels": self.compiled,
            "computes": self.own - self.compiled,
            "its processes compute": self.children,
            "waits for a processor: the machine is busy": self.starved,
            "waits: sleeps, sockets, processes": self.wall - self.own - self.starved,
        }
        name, seconds = max(parts.items(), key=lambda one: one[1])
        return f"{name} ({seconds:.1f} s)"


class Meter:
    """Measures one phase."""

    def __init__(self) -> None:
        self._wait = ProcessorWait()
        self._compiled = 0.0
        self._begin = self._now()
        self._timer = self._compiler()

    def spent(self) -> Spent:
        """What the phase has taken."""
        if self._timer is not None:
            self._timer.__exit__(None, None, None)
        wall, own, children, starved = (now - then for now, then in zip(self._now(), self._begin, strict=True))
        self._wait.close()
        return Spent(wall, own, children, starved, self._compiled)

    def _now(self) -> tuple[float, float, float, float]:
        times = os.times()
        return (
            time.monotonic(),
            times.user + times.system,
            times.children_user + times.children_system,
            self._wait.seconds() or 0.0,
        )

    def _compiler(self) -> Any:
        """A timer of the JIT compiler; its outermost compilations count."""
        from numba.core import event

        def add(seconds: float) -> None:
            self._compiled += seconds

        timer = event.install_timer("numba:compile", add)
        timer.__enter__()
        return timer


METER: Final = pytest.StashKey[Meter]()
"""Meter of the present phase."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the figures of the phase to its report, which also a worker process sends."""
    report = yield
    meter = item.stash.get(METER, None)
    if meter is not None:
        spent = meter.spent()
        figures = (spent.wall, spent.own, spent.children, spent.starved, spent.compiled)
        report.user_properties = [*report.user_properties, (KEY, figures)]
    item.stash[METER] = Meter()  # of the next phase
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Begin to measure."""
    item.stash[METER] = Meter()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the slowest phases, each with its reason."""
    found = []
    for reports in terminalreporter.stats.values():
        for report in reports:
            figures = dict(getattr(report, "user_properties", ())).get(KEY)
            if figures is not None:
                found.append((Spent(*figures), report.when, report.nodeid))
    found.sort(key=lambda one: -one[0].wall)
    total = sum(spent.wall for spent, _, _ in found)
    terminalreporter.section(f"the slowest of {len(found)} phases, {total:.0f} s in all")
    for spent, phase, name in found[:LISTED]:
        terminalreporter.write_line(f"{spent.wall:7.1f} s  {phase:<8} {spent.reason():<45} {name}")
