"""What the process measures of itself, and what a snapshot contains of guesses and loops."""

import errno
import io
import logging
import math
import mmap
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.integrity.state_memory import Memory
from daemon.runtime.snapshot_builder import Facts, SnapshotBuilder
from daemon.runtime.vitals import process_age_s, resident_mb
from daemon.snapshot import State
from daemon.system.logging import start_log
from estimator.result import Loop, StepResult

ROOT = Path(__file__).parents[3]


def test_the_age_of_the_process_is_that_of_the_kernel() -> None:
    code = "import time; time.sleep(0.3); from daemon.runtime.vitals import process_age_s; print(process_age_s())"
    begun = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    took = time.monotonic() - begun
    assert 0.28 <= float(done.stdout) <= took + 0.02
    assert process_age_s() > 0.0


def test_resident_memory_counts_what_is_touched() -> None:
    """With pages of its own: the allocator may hand out some that an earlier test has touched."""
    before = resident_mb()
    with mmap.mmap(-1, 50_000_000, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as ballast:
        for at in range(0, len(ballast), mmap.PAGESIZE):
            ballast[at] = 1
        assert 45.0 < resident_mb() - before < 60.0
    assert abs(resident_mb() - before) < 10.0


def test_memory_that_cannot_be_read_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(path: Path) -> str:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(Path, "read_text", none_left)
    assert math.isnan(resident_mb())


def test_a_stream_without_a_descriptor_is_logged_to_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    start_log()
    logging.getLogger("daemon").info("said")
    assert stream.getvalue().endswith("said\n")


def test_how_sure_a_guess_is_is_not_said() -> None:
    """While the place in the map is looked for the pose goes on, and neither axes nor deviations are known."""
    told = StepResult(
        1.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.ones(3), None, -1, None, 0, np.zeros(3), 0
    )
    verdict = Memory(State.RELOCATING, known=(True, True, True))
    sure, guess = (SnapshotBuilder().build(replace(told, places=places), verdict, Facts()) for places in (None, 2))
    assert sure.covariance is not None
    assert sure.known == (True, True, True)
    assert guess.pose is not None
    assert guess.covariance is None
    assert guess.known == (False, False, False)


def test_a_loop_is_latched_until_somebody_has_seen_it() -> None:
    told = StepResult(
        1.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.ones(3), None, -1, None, 0, np.zeros(3), 0
    )
    builder, verdict = SnapshotBuilder(), Memory()

    def latched(counter: int | None) -> bool:
        loop = None if counter is None else Loop(counter, 9, 2, 0.01)
        return builder.build(replace(told, loop=loop), verdict, Facts()).loop_latched

    assert [latched(None), latched(1), latched(None)] == [False, True, True]
    builder.loop_seen = 1
    assert [latched(None), latched(2)] == [False, True]
    builder.loop_seen = 1
    assert latched(None), "an acknowledgement that comes late loses no loop"
    builder.loop_seen = 0
    assert not latched(2**16), "the counter wraps"
