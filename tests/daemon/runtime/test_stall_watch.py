"""The stall watch names what ran: one of ours that works, one that waits, a thread, nothing."""

import asyncio
import logging
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from daemon.runtime.scheduler import IDLE_PERIODS
from daemon.runtime.stall_watch import Caught, StallWatch, cause
from tests.daemon.runtime.test_cycle import PERIOD, Bench, on_bench


@pytest.fixture
def watch() -> Iterator[StallWatch]:
    made = StallWatch()
    yield made
    made.close()


def burn(seconds: float) -> None:
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


def doze(seconds: float) -> None:
    time.sleep(seconds)


def test_what_worked_too_long_is_named_with_its_task(watch: StallWatch, caplog: pytest.LogCaptureFixture) -> None:
    async def go() -> float | None:
        asyncio.current_task().set_name("lidar")  # type: ignore[union-attr]  # there is one
        watch.arm(0.05)
        burn(0.2)
        return watch.arm(10.0)

    with caplog.at_level(logging.INFO):
        lasted = asyncio.run(go())
    assert lasted is not None
    assert lasted >= 0.2
    assert "test_stall_watch.burn" in watch.said
    assert "(task lidar)" in watch.said
    assert [record.getMessage() for record in caplog.records] == [watch.said]


def test_a_call_that_blocks_is_named(watch: StallWatch) -> None:
    watch.arm(0.05)
    doze(0.3)
    assert watch.arm(10.0) is not None
    assert "test_stall_watch.doze" in watch.said
    assert "waited" in watch.said or "other programs" in watch.said


def test_in_time_nothing_is_said_and_after_it_only_one_line_in_a_while(watch: StallWatch) -> None:
    for _ in range(3):
        assert watch.arm(30.0) is None
    assert watch.said == ""
    lasting = []
    for _ in range(3):
        watch.arm(0.02)
        doze(0.1)
        lasting.append(watch.arm(10.0))
    assert all(lasted is not None for lasted in lasting)
    assert watch.said.count("no cycle began") == 1
    assert "more" not in watch.said


async def test_the_loop_at_rest_is_not_blamed(watch: StallWatch) -> None:
    watch.arm(0.05)
    await asyncio.sleep(0.3)
    watch.arm(10.0)
    assert "no cycle began" in watch.said
    assert "burn" not in watch.said


def test_another_thread_that_works_meanwhile_is_named(watch: StallWatch) -> None:
    thread = threading.Thread(target=burn, args=(0.5,), name="lumiloop-search")
    thread.start()
    watch.arm(0.05)
    doze(0.3)
    watch.arm(10.0)
    thread.join()
    assert "lumiloop-search in" in watch.said or "other programs" in watch.said


def test_whose_fault_it_was() -> None:
    at = Caught("cycle.run > step", "cycle", "")
    assert "ran for 0.900 s" in cause(at, 1.0, 0.9, 0.0)
    assert "other programs used the processor for 0.800 s" in cause(at, 1.0, 0.1, 0.8)
    assert "a call blocked, or the process was stopped" in cause(at, 1.0, 0.1, 0.1)
    assert "a call blocked, or the process was stopped" in cause(at, 1.0, 0.1, None)
    assert "waited while x in y" in cause(Caught("cycle.run", "", "x in y"), 1.0, 0.1, 0.1)
    assert "no event arrived, neither a scan nor the timer" in cause(Caught("", "", ""), 1.0, 0.1, 0.1)
    assert "no event arrived, neither a scan nor the timer" in cause(Caught("", "", "x in y"), 1.0, 0.1, 0.1)
    assert "the loop waited while x in y" in cause(Caught("", "", "x in y", late=0.5), 1.0, 0.1, 0.1)
    assert "the process was stopped" in cause(Caught("", "", "", late=0.5), 1.0, 0.1, 0.1)


def test_closed_it_gives_the_signal_back() -> None:
    before = signal.getsignal(signal.SIGALRM)
    watch = StallWatch()
    watch.arm(0.01)
    watch.close()
    watch.close()
    time.sleep(0.05)
    assert signal.getsignal(signal.SIGALRM) is before


class Told:
    """A watch that says of the cycles that begin what a test wants."""

    def __init__(self, *lasted: float | None) -> None:
        self._lasted = iter(lasted)

    def arm(self, seconds: float) -> float | None:
        return next(self._lasted, None)

    def close(self) -> None:
        return


@pytest.mark.jit
def test_how_late_the_loop_was_is_told_once_whenever_it_stood_still() -> None:
    """The heartbeat alone, once a second, would see a stop of half a second now and then."""
    told: list[float] = []

    async def driven(bench: Bench) -> None:
        bench.pacemaker.watch = Told(None, None, 0.6, 0.9, None)
        for begin in range(0, 16, 8):
            await bench.drive(begin, 8)
            told.append(bench.pacemaker.latest())

    on_bench(driven)
    assert told == [pytest.approx(0.9 - IDLE_PERIODS * PERIOD), 0.0]
