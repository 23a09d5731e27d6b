"""Too little memory is named as such, wherever a command runs out of it."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.system import memory_limit
from daemon.system.memory_limit import lacks_memory

ROOT = Path(__file__).parents[3]
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
