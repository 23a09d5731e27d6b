"""Real-time scheduling and locked memory, in processes of their own."""

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.system import realtime

ROOT = Path(__file__).parents[3]
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may take SCHED_FIFO without a limit that says so")


def said_by(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_without_the_units_limits_nothing_is_taken() -> None:
    assert realtime._schedule(0).startswith("ordinary scheduling")
    assert realtime._lock(8 << 20).startswith("memory not locked")
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@needs_root
@pytest.mark.parametrize(("most", "priority"), [(50, 40), (20, 20), (resource.RLIM_INFINITY, 40)])
def test_the_loops_thread_takes_its_priority_and_later_threads_do_not(most: int, priority: int) -> None:
    code = f"""
import os, threading
from daemon.system import realtime
text = realtime._schedule({most})
seen = []
thread = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
thread.start(); thread.join()
policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
print(text, policy == os.SCHED_FIFO, os.sched_getparam(0).sched_priority, seen[0] == os.SCHED_OTHER)
"""
    assert said_by(code) == f"SCHED_FIFO {priority} True {priority} True"


@needs_root
def test_locked_memory_holds_what_is_touched_and_no_more() -> None:
    code = f"""
import mmap
from pathlib import Path
from daemon.system import realtime
text = realtime._lock({resource.RLIM_INFINITY})
held = mmap.mmap(-1, 256 << 20)
held[:1 << 20] = bytes(1 << 20)
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(text, int(status["VmLck"].split()[0]) > 256 << 10, int(status["VmRSS"].split()[0]) < 128 << 10)
"""
    said = said_by(code)
    if said.startswith("memory not locked"):
        pytest.skip(f"this machine does not let root lock memory: {said}")
    assert said == "memory locked True True"


def test_a_kernel_that_refuses_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert realtime._schedule(40) == "ordinary scheduling (Operation not permitted)"


def test_threads_that_cannot_be_listed_are_lined_up_later(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(folder: Path) -> Iterator[Path]:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(os, "sched_getscheduler", lambda thread: os.SCHED_FIFO)
    monkeypatch.setattr(Path, "iterdir", none_left)
    assert realtime.line_up() == 0


@needs_root
def test_other_threads_come_right_behind_the_loop_once_it_is_ahead_and_later_ones_too() -> None:
    code = f"""
import os, threading
from daemon.system import realtime

def made():
    asked, told, found = threading.Event(), threading.Event(), []
    def stay():
        told.set(); asked.wait()
        found.append((os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(0).sched_priority))
    thread = threading.Thread(target=stay)
    thread.start(); told.wait()
    def end():
        asked.set(); thread.join()
        return found[0] == (os.SCHED_RR, 1)
    return end

one, nothing = made(), realtime.line_up()
realtime._schedule({resource.RLIM_INFINITY})
first = realtime.line_up()
other, second, third = made(), realtime.line_up(), realtime.line_up()
print(nothing, first >= 1, second, third, one(), other(), os.sched_getparam(0).sched_priority)
"""
    assert said_by(code) == "0 True 1 0 True True 40"


HELD = """
import ctypes, sys
from daemon.system import realtime
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

def large():
    block = libc.malloc(20_000_000)
    ctypes.memset(block, 1, 20_000_000)
    return block

{call}
libc.free(large())  # from which glibc learns
before = resident()
block = large()
small = libc.malloc(100_000)  # outlives it
libc.free(block)
print(resident() - before)
"""


def test_what_a_large_job_has_needed_is_given_back() -> None:
    assert float(said_by(HELD.format(call=""))) > 15.0, "glibc has become wiser: the call can go"
    assert float(said_by(HELD.format(call="realtime.give_back()"))) < 1.0


GROWN = """
import ctypes, threading
from daemon.system import realtime
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

kept = []

def grow():
    for _ in range(600):
        ctypes.memset(libc.malloc(16_000), 1, 16_000)
    kept.extend(bytes(200) for _ in range(9_000))

{call}
before = resident()
thread = threading.Thread(target=grow)
thread.start(); thread.join()
print(resident() - before)
"""


@pytest.mark.parametrize("call", ["", "realtime.give_back()", "realtime.reserve()"])
def test_a_map_that_grows_needs_more_memory_without_either(call: str) -> None:
    assert float(said_by(GROWN.format(call=call))) > 8.0, "one of the two calls is enough: the other can go"


def test_a_map_that_grows_takes_what_was_reserved_whichever_thread_makes_it() -> None:
    assert float(said_by(GROWN.format(call="realtime.give_back(); realtime.reserve()"))) < 1.0
