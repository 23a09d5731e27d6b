"""What the process knows of itself, and how it logs."""

from __future__ import annotations

import errno
import io
import logging
import math
import mmap
import subprocess
import sys
import time
from pathlib import Path

import pytest

from daemon.runtime.vitals import process_age_s, resident_mb
from daemon.system.logging import start_log

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
