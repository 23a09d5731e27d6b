"""Figures of the process and its limit of memory."""

import errno
import os
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from daemon.system import descriptors, memory_limit
from daemon.system.memory_limit import lacks_memory
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


MISSING = OSError("Could not find/load shared object file 'libllvmlite.so'. The library literally cannot be found")


@pytest.mark.parametrize("megabytes", [60, 160, 300])
def test_a_command_under_a_memory_limit_names_it(megabytes: int) -> None:
    """At each of them another library is the first that cannot be loaded."""
    size = megabytes << 20
    done = subprocess.run(
        [sys.executable, "-m", "daemon", "warm"], cwd=ROOT, capture_output=True, text=True, timeout=120.0,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (size, size)),
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("lumiloop: not enough memory")
    assert "raise `MemoryMax=`" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), True),
        (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), True),
        (ImportError("libx.so: failed to map segment from shared object"), True),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), False),
        (ModuleNotFoundError("No module named 'aiohttp'"), False),
        (MISSING, False),
    ],
    ids=repr,
)
def test_only_a_lack_of_memory_is_one(error: BaseException, expected: bool) -> None:
    assert lacks_memory(error) is expected
    outer = RuntimeError("loading failed")
    outer.__context__ = error
    assert lacks_memory(outer) is expected


def test_a_library_that_is_not_found_is_judged_by_the_memory_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_limit, "NEEDED", 1 << 60)
    assert lacks_memory(MISSING)
