"""Background worker: runs nogil jobs that must not delay a cycle, and applies each job result in a definite cycle.

There are three workers with one interface: threads for real time, a fixed number of cycles for virtual time, and a
recorded schedule for replay. Job results are applied only where a cycle collects them, so that a run can be repeated
exactly.
"""

from __future__ import annotations

import logging
import queue
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Final, Protocol

from estimator import Answer, Job

log = logging.getLogger(__name__)

ANSWER_CYCLES: Final = 4
"""Cycles from a job to its result under the virtual clock."""

URGENT: Final = 2
"""Jobs with this priority or a lower number do not wait for others."""

SWITCH_S: Final = 5e-4
"""Time after which a thread in Python yields, s. With the interpreter's own 5 ms, a cycle waits after each of its
kernels while a job prepares its data."""

TRIES: Final = 3
PAUSE_S: Final = 0.2
"""Pause between the :data:`TRIES` runs of a job that raises, s; in real time only."""


_Waiting = queue.PriorityQueue[tuple[int, int, Job | None]]


class Worker(Protocol):
    """Accepts jobs at the end of a cycle and returns their results at the start of a later one."""

    @property
    def failed(self) -> int:
        """Jobs that raised in every run; they have no result."""
        ...

    def submit(self, jobs: Iterable[Job]) -> None:
        """Accepts jobs; returns at once."""
        ...

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Returns finished job results in order of completion, stamped with the cycle's start. Once per cycle."""
        ...

    def close(self) -> None:
        """Drops waiting jobs; idempotent."""
        ...


class ThreadWorker:
    """Two threads, each with jobs by priority, first come first served within one. Real time only.

    One thread runs the jobs that the pose waits for (finishing submaps, solving the graph). A long search never delays
    them. If both threads run Python, the cycle continues at the next thread switch: see :data:`SWITCH_S`.

    Attributes:
        since: start of each thread's present job (`time.monotonic`, s); None while it waits.
    """

    def __init__(self) -> None:
        self.failed = 0
        self.since: list[float | None] = [None, None]
        self._waiting = [_Waiting(), _Waiting()]
        self._done: queue.SimpleQueue[tuple[int, object] | None] = queue.SimpleQueue()
        self._submitted = 0
        self._closed = threading.Event()
        sys.setswitchinterval(SWITCH_S)
        names = "lumiloop-solver", "lumiloop-search"
        self._threads = [
            threading.Thread(target=self._work, args=(number,), name=name, daemon=True)
            for number, name in enumerate(names)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, jobs: Iterable[Job]) -> None:
        """Accepts jobs; returns at once."""
        for job in jobs:
            self._submitted += 1
            self._waiting[job.priority > URGENT].put((job.priority, self._submitted, job))

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Returns the job results that are finished by now."""
        answers = []
        while not self._done.empty():
            done = self._done.get_nowait()
            if done is None:
                self.failed += 1
            else:
                answers.append(Answer(t_mono, *done))
        return tuple(answers)

    def close(self) -> None:
        """Drops waiting jobs and gives running ones a second; the threads otherwise end with the process."""
        self._closed.set()
        for waiting in self._waiting:
            waiting.put((-1, 0, None))
        until = time.monotonic() + 1.0
        for thread in self._threads:
            thread.join(timeout=max(0.0, until - time.monotonic()))

    def _work(self, number: int) -> None:
        while not self._closed.is_set():
            _, _, job = self._waiting[number].get()
            if job is not None:
                self.since[number] = time.monotonic()
                self._done.put(_run(job, PAUSE_S))
                self.since[number] = None


class CycleWorker:
    """Virtual time: every job has its result a fixed number of cycles after submission, by priority."""

    def __init__(self, cycles: int = ANSWER_CYCLES) -> None:
        self.failed = 0
        self._cycles = cycles
        self._cycle = 0
        self._due: dict[int, list[Job]] = {}

    def submit(self, jobs: Iterable[Job]) -> None:
        """Accepts jobs; they run when they are due."""
        self._due.setdefault(self._cycle + self._cycles, []).extend(jobs)

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Runs the jobs that are due in this cycle and returns their results."""
        self._cycle += 1
        due = sorted(self._due.pop(self._cycle, ()), key=lambda job: job.priority)
        done = [_run(job) for job in due]
        self.failed += done.count(None)
        return tuple(Answer(t_mono, *item) for item in done if item is not None)

    def close(self) -> None:
        """Drops waiting jobs."""
        self._due.clear()


class ScheduledWorker:
    """Replay of a recording: each job result is applied in the cycle in which it was applied when recorded."""

    def __init__(
        self, schedule: Mapping[int, tuple[int, ...]], cycle: int = 0, jobs: Mapping[int, Job] | None = None
    ) -> None:
        """``schedule``: job IDs applied in each cycle, in order, by cycle number from 1.

        ``cycle``: the last one before the start. ``jobs``: pending at that time, by ID.
        """
        self.failed = 0
        self._schedule = schedule
        self._cycle = cycle
        self._jobs: dict[int, Job] = dict(jobs or {})

    def submit(self, jobs: Iterable[Job]) -> None:
        """Keeps jobs until the schedule needs them; other jobs had no result when recorded."""
        self._jobs.update((job.job_id, job) for job in jobs)

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Runs the scheduled jobs and returns their results.

        Raises:
            LookupError: the recording applied the result of a job that this run has not submitted.
        """
        self._cycle += 1
        answers = []
        for job_id in self._schedule.get(self._cycle, ()):
            if job_id not in self._jobs:
                raise LookupError(
                    f"cycle {self._cycle}: job {job_id} was never requested; the recording may be from other software"
                )
            done = _run(self._jobs.pop(job_id))
            if done is not None:
                answers.append(Answer(t_mono, *done))
        return tuple(answers)

    def close(self) -> None:
        """Drops waiting jobs."""
        self._jobs.clear()


def _run(job: Job, pause_s: float = 0.0) -> tuple[int, object] | None:
    """Runs one job; a defect in it is logged and loses its result, but never stops the daemon.

    A job changes nothing and can run again. A job that fails, for example for lack of memory, runs up to :data:`TRIES`
    times. The map waits for it: without its result a submap might never be finished.
    """
    for left in reversed(range(TRIES)):
        try:
            return job.job_id, job.run()
        except Exception:  # a job may raise anything; its failure is counted, published and logged in full
            log.exception("background job %d failed%s", job.job_id, "; the daemon tries again" if left else "")
            time.sleep(pause_s if left else 0.0)
    return None
