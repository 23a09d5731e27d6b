"""Figures of the process: descriptors that are left, and time for which the loop waits for the processor."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from daemon.system import descriptors
from daemon.system.processor_wait import ProcessorWait

ROOT = Path(__file__).parents[3]


def test_descriptors_are_used_up_before_the_last_one_is_taken() -> None:
    """In a process of its own: the limit holds for all threads."""
    program = (
        "import os, resource\n"
        "from daemon.system.descriptors import RESERVE, used_up\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))\n"
        "kept, seen = [], []\n"
        "while True:\n"
        "    seen.append(used_up())\n"
        "    try: kept.append(os.open('/dev/null', os.O_RDONLY))\n"
        "    except OSError: break\n"
        "assert not seen[0] and seen[-1]\n"
        "assert RESERVE - 1 <= sum(seen) <= RESERVE + 1, sum(seen)\n"
        "for one in kept: os.close(one)\n"
        "assert not used_up()\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, timeout=60.0)


def test_another_error_is_no_lack_of_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object) -> int:
        raise PermissionError(13, "no")

    monkeypatch.setattr(os, "open", refuse)
    assert not descriptors.used_up()


def test_the_wait_is_that_of_the_thread_that_asked_and_only_grows() -> None:
    wait = ProcessorWait()
    first = wait.seconds()
    if first is None:
        pytest.skip("this kernel has no schedstat")
    spinning = threading.Thread(target=lambda: sum(range(3_000_000)))
    spinning.start()
    time.sleep(0.05)
    spinning.join()
    second = wait.seconds()
    assert second is not None
    assert 0.0 <= first <= second
    wait.close()
    wait.close()
