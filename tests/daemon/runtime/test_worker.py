"""Background work: order, virtual and recorded answers, and jobs that fail."""

import logging
import sys
import threading

import pytest

from daemon.runtime.worker import ANSWER_CYCLES, TRIES, URGENT, CycleWorker, ScheduledWorker, ThreadWorker, Worker
from estimator.measurements import Job


def job(number: int, priority: int = 0) -> Job:
    return Job(number, priority, lambda: number * 10)


def broken(number: int, priority: int = 0) -> Job:
    def run() -> object:
        raise ValueError("no such map")

    return Job(number, priority, run)


def answers(worker: Worker, t_mono: float = 1.0) -> list[tuple[int, object]]:
    return [(answer.job_id, answer.payload) for answer in worker.collect(t_mono)]


def test_virtual_time_answers_after_a_fixed_number_of_cycles() -> None:
    worker = CycleWorker()
    assert answers(worker) == []
    worker.submit([job(1, priority=5), job(2, priority=1)])
    for _ in range(ANSWER_CYCLES - 1):
        assert answers(worker) == []
    (first, second) = worker.collect(7.5)
    assert (first.job_id, second.job_id) == (2, 1)
    assert (first.payload, first.t_begin) == (20, 7.5)
    assert answers(worker) == []


def test_a_failing_job_costs_its_answer_and_is_said(caplog: pytest.LogCaptureFixture) -> None:
    worker = CycleWorker(cycles=1)
    worker.submit([broken(1), job(2)])
    assert answers(worker) == [(2, 20)]
    assert worker.failed == 1
    assert "background job 1 failed" in caplog.text
    assert "no such map" in caplog.text


def test_a_job_that_fails_in_a_bad_moment_is_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    tried = []

    def second_time() -> object:
        tried.append(True)
        if len(tried) == 1:
            raise MemoryError
        return "found"

    worker = CycleWorker(cycles=1)
    worker.submit([Job(1, 0, second_time), broken(2)])
    assert answers(worker) == [(1, "found")]
    assert worker.failed == 1
    assert caplog.text.count("background job 1 failed") == 1
    assert caplog.text.count("background job 2 failed") == TRIES


def test_a_recording_decides_in_which_cycle_an_answer_is_applied() -> None:
    worker = ScheduledWorker({2: (8, 7), 3: (9,)})
    worker.submit([job(7), job(8)])
    assert answers(worker) == []
    assert answers(worker) == [(8, 80), (7, 70)]
    worker.submit([job(9)])
    assert answers(worker) == [(9, 90)]


def test_an_answer_to_a_job_that_was_never_asked_for_is_refused() -> None:
    with pytest.raises(LookupError, match="cycle 1: job 5 was never requested"):
        ScheduledWorker({1: (5,)}).collect(0.0)


def test_the_thread_runs_urgent_jobs_first_and_survives_failures(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)
    worker = ThreadWorker()
    gate, started, finished = threading.Event(), threading.Event(), threading.Event()

    def hold() -> object:
        started.set()
        gate.wait(10.0)
        return "held"

    worker.submit([Job(1, URGENT + 1, hold)])
    assert started.wait(10.0)
    last = Job(5, 99, lambda: finished.set() or "last")
    worker.submit([job(2, priority=9), job(3, priority=URGENT + 2), broken(4, priority=URGENT + 1), last])
    assert answers(worker) == []
    gate.set()
    assert finished.wait(10.0)
    worker.close()
    assert answers(worker) == [(1, "held"), (3, 30), (2, 20), (5, "last")]
    assert worker.failed == 1
    assert not {"lumiloop-solver", "lumiloop-search"} & {thread.name for thread in threading.enumerate()}


def test_what_the_pose_waits_for_does_not_wait_for_a_search() -> None:
    worker = ThreadWorker()
    gate, started, solved = threading.Event(), threading.Event(), threading.Event()
    worker.submit([Job(1, URGENT + 1, lambda: started.set() or gate.wait(10.0))])
    assert started.wait(10.0)
    worker.submit([Job(2, URGENT, lambda: solved.set() or "solved")])
    assert solved.wait(10.0)  # the search is still held
    gate.set()
    worker.close()
    assert answers(worker) == [(2, "solved"), (1, True)]


def test_a_thread_that_runs_python_soon_gives_way() -> None:
    """After each of its kernels a cycle waits for the interpreter; what is usual, 5 ms, is a fifth of a period."""
    worker = ThreadWorker()
    worker.close()
    assert sys.getswitchinterval() <= 1e-3


def test_closing_drops_what_waits() -> None:
    worker = ThreadWorker()
    gate, started = threading.Event(), threading.Event()
    worker.submit([Job(1, 0, lambda: started.set() or gate.wait(10.0)), job(2)])
    assert started.wait(10.0)
    threading.Timer(0.05, gate.set).start()
    worker.close()
    worker.close()
    assert [number for number, _ in answers(worker)] == [1]
