"""Background work: nogil jobs that must not delay a cycle, and the cycle in which each answer is applied.

Three workers behind one interface: a thread for real time; a fixed number of cycles for virtual time; a recorded
schedule for replay. Answers are applied only where a cycle collects them, so what a run did can be repeated exactly.
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
"""Under the virtual clock a job answers after this many cycles."""

URGENT: Final = 2
"""Jobs of this priority or a lower number do not wait for others."""

SWITCH_S: Final = 5e-4
"""A thread that runs Python gives way after so long (the interpreter's own 5 ms would be waited for after every kernel
of a cycle while a job prepares its numbers)."""

TRIES: Final = 3
PAUSE_S: Final = 0.2
"""A job that raises is run so often, in real time with a pause between."""


_Waiting = queue.PriorityQueue[tuple[int, int, Job | None]]


class Worker(Protocol):
    """Takes jobs at the end of a cycle, gives answers at the start of a later one."""

    @property
    def failed(self) -> int:
        """Jobs that raised each time they were tried; they never answer."""
        ...

    def submit(self, jobs: Iterable[Job]) -> None:
        """Take jobs; returns at once."""
        ...

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Answers that are ready, in the order they were finished, stamped with the cycle's start. Once per cycle."""
        ...

    def close(self) -> None:
        """Drop what waits; idempotent."""
        ...


class ThreadWorker:
    """Two threads, each with jobs by priority, first come first served within one. Real time only.

    One is for what the pose waits for (settling, solving the graph): a search that runs for long never delays it.
    Where both work in Python, the cycle gets its turn at the next switch of threads: see :data:`SWITCH_S`.

    Attributes:
        since: when each thread began the job that it is at (`time.monotonic`), None while it waits.
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
        """Take jobs; returns at once."""
        for job in jobs:
            self._submitted += 1
            self._waiting[job.priority > URGENT].put((job.priority, self._submitted, job))

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Answers that are ready by now."""
        answers = []
        while not self._done.empty():
            done = self._done.get_nowait()
            if done is None:
                self.failed += 1
            else:
                answers.append(Answer(t_mono, *done))
        return tuple(answers)

    def close(self) -> None:
        """Drop what waits and give the running jobs a second; the threads die with the process otherwise."""
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
    """Virtual time: every job answers a fixed number of cycles after it was submitted, by priority."""

    def __init__(self, cycles: int = ANSWER_CYCLES) -> None:
        self.failed = 0
        self._cycles = cycles
        self._cycle = 0
        self._due: dict[int, list[Job]] = {}

    def submit(self, jobs: Iterable[Job]) -> None:
        """Take jobs; they run when they are due."""
        self._due.setdefault(self._cycle + self._cycles, []).extend(jobs)

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Run and answer what is due in this cycle."""
        self._cycle += 1
        due = sorted(self._due.pop(self._cycle, ()), key=lambda job: job.priority)
        done = [_run(job) for job in due]
        self.failed += done.count(None)
        return tuple(Answer(t_mono, *item) for item in done if item is not None)

    def close(self) -> None:
        """Drop what waits."""
        self._due.clear()


class ScheduledWorker:
    """Replay of a recording: each answer is applied in the cycle in which it was applied when recorded."""

    def __init__(
        self, schedule: Mapping[int, tuple[int, ...]], cycle: int = 0, jobs: Mapping[int, Job] | None = None
    ) -> None:
        """Take the schedule: cycle number, counted from 1, to the job IDs applied in it, in order.

        ``cycle``: the last one before this, and ``jobs`` by ID that were under way then.
        """
        self.failed = 0
        self._schedule = schedule
        self._cycle = cycle
        self._jobs: dict[int, Job] = dict(jobs or {})

    def submit(self, jobs: Iterable[Job]) -> None:
        """Keep jobs until the schedule calls for them; one it never calls for had not answered when recorded."""
        self._jobs.update((job.job_id, job) for job in jobs)

    def collect(self, t_mono: float) -> tuple[Answer, ...]:
        """Run and answer what the schedule says.

        Raises:
            LookupError: the recording applied an answer to a job that this run has not asked for.
        """
        self._cycle += 1
        answers = []
        for job_id in self._schedule.get(self._cycle, ()):
            if job_id not in self._jobs:
                raise LookupError(f"cycle {self._cycle}: job {job_id} was never asked for; recorded by other software?")
            done = _run(self._jobs.pop(job_id))
            if done is not None:
                answers.append(Answer(t_mono, *done))
        return tuple(answers)

    def close(self) -> None:
        """Drop what waits."""
        self._jobs.clear()


def _run(job: Job, pause_s: float = 0.0) -> tuple[int, object] | None:
    """Run one job; a defect in it is logged and costs its answer, never the daemon.

    A job changes nothing and can be run again: what fails for want of memory, say, is tried :data:`TRIES` times. The
    map waits for it, and one without which a submap would never be finished must not be lost to a bad moment.
    """
    for left in reversed(range(TRIES)):
        try:
            return job.job_id, job.run()
        except Exception:  # a job is arbitrary work; its failure is counted, published and logged in full
            log.exception("background job %d failed%s", job.job_id, "; it is tried again" if left else "")
            time.sleep(pause_s if left else 0.0)
    return None
