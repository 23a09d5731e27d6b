"""Threads that hang: which are said, which keep the watchdog from being fed; and the condition that is published."""

import asyncio
import logging
import threading
import time
from pathlib import Path

import pytest

from daemon import app
from daemon.environment import Environment
from daemon.health.assessment import Vitals
from daemon.health.faults import Fault
from daemon.health.present_faults import PresentFaults
from daemon.health.report import Reporter
from daemon.health.supervisor import Supervisor
from daemon.health.thread_watch import COMPUTING_S, DISK_S, ThreadWatch
from daemon.runtime.heartbeat import Heartbeat
from daemon.runtime.worker import URGENT, ThreadWorker
from daemon.snapshot import Part, Thread
from estimator.measurements import Job
from hal.clock import LoopClock
from hal.lidar import LidarStatus
from tests.daemon.scenarios.test_daemon import SETTINGS


class Stand:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.t = 100.0

    def now(self) -> float:
        return self.t

    def utc(self) -> float:
        return 1.7e9 + self.t


@pytest.mark.parametrize("thread", Thread)
def test_a_thread_that_hangs_is_said_once_each_way(thread: Thread, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    clock, since = Stand(), [None, 100.0, 100.0, 100.0, None]
    answers = ThreadWatch(clock.now)
    answers.watch(thread, lambda: since[0], DISK_S)
    for begun, later in zip(since, (0.0, 0.0, DISK_S + 1.0, 1.0, 1.0), strict=True):
        since[0], clock.t = begun, clock.t + later
        answers.look()
    assert [record.levelname for record in caplog.records] == ["ERROR", "INFO"]
    assert answers.hanging == frozenset()


def test_only_what_a_restart_cures_keeps_the_watchdog_hungry() -> None:
    for thread in Thread:
        clock = Stand()
        answers = ThreadWatch(clock.now)
        answers.watch(thread, lambda: 0.0, COMPUTING_S)
        clock.t = COMPUTING_S + 1.0
        assert answers.look() == {thread}
        assert answers.alive == (thread not in (Thread.SOLVER, Thread.SEARCH))


def test_the_watchdog_is_fed_only_while_cycles_go_on_and_threads_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    fed: list[str] = []
    monkeypatch.setattr("daemon.runtime.heartbeat.notify", fed.append)
    cycles, alive = [0], [True]
    heart = Heartbeat(lambda lateness: Vitals(float(cycles[0]), cycles=cycles[0]), str, lambda: alive[0])
    for answers, step, more in ((True, 1, 1), (True, 1, 1), (False, 1, 0), (True, 1, 1), (True, 0, 0)):
        alive[0], cycles[0], before = answers, cycles[0] + step, len(fed)
        heart.beat(0.0)
        assert len(fed) - before == more


def test_a_worker_says_since_when_a_job_runs() -> None:
    go, worker = threading.Event(), ThreadWorker()
    try:
        assert worker.since == [None, None]
        worker.submit([Job(1, 0, go.wait)])
        end = time.monotonic() + 5.0
        while worker.since[0] is None and time.monotonic() < end:
            time.sleep(0.005)
        assert worker.since[0] is not None
        assert worker.since[1] is None
        go.set()
        while worker.since[0] is not None and time.monotonic() < end:
            time.sleep(0.005)
        assert worker.since == [None, None]
    finally:
        go.set()
        worker.close()


def test_the_condition_is_one_object_until_something_changes(tmp_path: Path) -> None:
    clock, supervisor, present = Stand(), Supervisor(), PresentFaults((Fault.LIDAR_SILENT,))
    lidar = LidarStatus()
    reporter = Reporter(clock, supervisor, ThreadWatch(clock.now), present, (lidar, None))
    first = reporter()
    clock.t += 0.5
    assert reporter() is first
    assert (first.uptime_s, first.faults) == (0, (104,))
    present.faults = (Fault.LIDAR_SILENT, Fault.OVERRUNS)
    assert reporter().faults == (104, 302)
    lidar.reconnects, lidar.resyncs = 2, 3
    supervisor.restarts.update({"pose": 4, "something new": 1, "lidar": 1})
    supervisor.failed |= {"pose", "something new"}
    clock.t += 1.0
    told = reporter()
    assert told.uptime_s == 1
    assert (told.restarts[Part.LIDAR], told.restarts[Part.POSE], told.restarts[Part.OTHER]) == (6, 4, 1)
    assert told.down == {Part.POSE, Part.OTHER}


@pytest.mark.parametrize("thread", [Thread.SOLVER, Thread.SEARCH])
@pytest.mark.virtual
async def test_background_work_that_hangs_is_a_fault_within_seconds_and_starves_the_watchdog(
    thread: Thread, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole daemon, whose worker waits for ever; the map gives such a job up only after many keyframes."""
    monkeypatch.setattr(app, "COMPUTING_S", 0.05)
    fed: list[str] = []
    monkeypatch.setattr("daemon.runtime.heartbeat.notify", lambda *words: fed.extend(words))
    go = threading.Event()
    clock = LoopClock(asyncio.get_running_loop())
    daemon = app.Daemon(SETTINGS, Environment(clock, make_worker=ThreadWorker, draw_map_id=lambda: 1))
    worker = daemon.cycle.parts.worker
    assert isinstance(worker, ThreadWorker)
    try:
        for _ in range(3):
            daemon.cycle.cycles += 1
            daemon.heartbeat.beat(0.0)
        assert daemon.heartbeat.faults == ()
        assert fed.count("WATCHDOG=1") == 3
        worker.submit([Job(1, URGENT if thread is Thread.SOLVER else URGENT + 1, go.wait)])
        end = time.monotonic() + 5.0
        while Fault.THREAD_HANGS not in daemon.heartbeat.faults and time.monotonic() < end:
            time.sleep(0.01)  # noqa: ASYNC251  # the thread's time is the real one
            fed.clear()
            daemon.cycle.cycles += 1
            daemon.heartbeat.beat(0.0)
        assert daemon.threads.hanging == {thread}
        assert daemon.heartbeat.faults == (Fault.THREAD_HANGS,)
        assert "WATCHDOG=1" not in fed
    finally:
        go.set()
        worker.close()
