"""Warm-up: loads the estimator, and compiles its kernels under a lock at the first start.

Importing the estimator compiles the kernels; later starts load them from the cache. Two processes that compile at once
could damage the cache's index; hence the lock (`daemon.system.kernel_lock`), which is not needed if all kernels are
present. The daemon must keep communicating with its devices meanwhile; hence the thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import hashlib
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.system.atomic_file import sync_folder, write_whole
from daemon.system.kernel_lock import KernelLock, before_compiling, waits
from daemon.system.memory_limit import REMEDY, lacks_memory
from hal.blocking_calls import run_in_thread

if TYPE_CHECKING:
    from daemon.devices.light_setup import Lights

log = logging.getLogger(__name__)

ROOM: Final = Path(__file__).resolve().parents[2] / "estimator"
LIGHT: Final = ("cdma", "light_filter")
"""Packages of the estimator that are loaded only where there is a photodiode."""
OFFLINE: Final = ("calibration", "paper", "floorplan_import")
"""Packages and modules of the estimator that no daemon loads."""
TIMED_CODES: Final = 129
TIMED_TURNS: Final = 5

CPUINFO: Final = Path("/proc/cpuinfo")
MAKE: Final = frozenset({
    "vendor_id", "cpu family", "model", "model name", "stepping", "flags",
    "CPU implementer", "CPU architecture", "CPU variant", "CPU part", "CPU revision", "Features",
})  # fmt: skip
"""Keys in /proc/cpuinfo of the processor's type, for x86 and for ARM."""
REPORT_S: Final = 5.0
"""Seconds between two progress lines."""
EACH: Final = "they cannot be stored, so each start compiles them"
_one: Final = threading.Lock()
"""Serialises loading within one process."""
LOOK_S: Final = 0.5
"""Interval between two checks for the first compiled kernel, s."""


class CannotLoad(Exception):
    """The estimator cannot be loaded; the text gives the cause and the remedy."""


@dataclass(frozen=True, slots=True)
class Warmth:
    """Result of the warm-up.

    Attributes:
        compiled: kernels had to be compiled. seconds: duration, s. code_us: cost of the search for one light code on
            this computer, us; 0 without lights. damaged: number of cache files that existed and could not be used.
            unwritten: reason why compiled kernels could not be stored, empty: none failed.
    """

    compiled: bool
    seconds: float
    code_us: float = 0.0
    damaged: int = 0
    unwritten: str = ""


async def warm_up(progress: Callable[[str], None] = log.info, lights: Lights | None = None) -> Warmth:
    """Loads the estimator in a thread; ``progress`` receives a line every few seconds while kernels compile.

    A stop during the first start does not wait for the compiler. The packages for light are loaded only if ``lights``
    is given.
    """
    begun = time.monotonic()
    loading = run_in_thread(load if lights is None else partial(load, lights), "warm-up")
    while not loading.done():
        await asyncio.wait([loading], timeout=REPORT_S)
        if not loading.done() and (line := _progress_line(time.monotonic() - begun, lights is not None)):
            progress(line)
    warmth = loading.result()
    gc.collect()
    gc.freeze()  # present objects stay: the collector need not scan them during a cycle
    if warmth.compiled:
        later = EACH if warmth.unwritten else "later starts load them in less than a second"
        progress(f"kernels compiled in {warmth.seconds:.0f} s; {later}")
    return warmth


def load(lights: Lights | None = None) -> Warmth:
    """Imports and exercises the estimator. Blocks; for a thread, or for a command that may wait.

    If kernels are missing, it waits until no other process compiles any; otherwise it waits for no process.

    Raises:
        CannotLoad: there is no folder for compiled kernels, memory must not be made executable here, or there is not
            enough of it.
    """
    begun = time.monotonic()
    try:
        with _one:
            return _load(begun, lights)
    except (MemoryError, ImportError) as error:
        raise CannotLoad(_cause_of(error)) from error
    except PermissionError as error:
        remedy = "allow the process to make memory executable"  # see MemoryDenyWriteExecute= (systemd.exec)
        if error.filename is not None:
            remedy = "give this user write access to that file, or name another folder with NUMBA_CACHE_DIR"
        raise CannotLoad(f"kernels cannot be compiled: {error}; {remedy}") from error
    except (OSError, RuntimeError) as error:
        raise CannotLoad(_cause_of(error)) from error


def _cause_of(error: BaseException) -> str:
    """Readable cause of a failure to load."""
    if lacks_memory(error):
        return f"not enough memory to load the kernels; {REMEDY}"
    return f"kernels cannot be loaded: {error}"


def load_aloud(say: Callable[[str], None], what: str, work: Callable[[], object], module: str = "") -> None:
    """Runs ``work``, which loads ``what`` of the estimator, and reports by ``say`` that kernels are being compiled.

    ``say`` is called in another thread. Nothing runs if an earlier start has compiled everything, and ``say`` is not
    called if no kernel is missing. ``module``: imported afterwards; its missing kernels are compiled under the lock.

    Raises:
        CannotLoad: as for :func:`load`.
    """
    try:
        if is_marked(what):
            return
        begun, before = time.monotonic(), _compiled()
        with _announced(say, before):
            work()
            if module:
                _import(module)
        _mark(what)
    except (OSError, RuntimeError) as error:
        raise CannotLoad(f"kernels cannot be loaded: {error}") from error
    if count := len(_compiled() - before):
        say(f"kernels compiled: {count}, in {time.monotonic() - begun:.0f} s; later starts load them in about a second")


def _import(module: str) -> None:
    """Imports a module of kernels that no daemon loads."""
    from estimator import CACHE_DIR

    with KernelLock(CACHE_DIR) as lock, before_compiling(lock.acquire):
        import_module(module)


@contextlib.contextmanager
def _announced(say: Callable[[str], None], before: set[Path]) -> Iterator[None]:
    """Context that calls ``say`` once the first kernel is compiled that was not there ``before``."""
    done = threading.Event()

    def look() -> None:
        while not done.wait(LOOK_S):
            if _compiled() - before:
                say("compiling numerical kernels, once for each version (up to two minutes)")
                return

    looking = threading.Thread(target=look, name="lumiloop-compiling", daemon=True)
    looking.start()
    try:
        yield
    finally:
        done.set()
        looking.join()


def _compiled() -> set[Path]:
    from estimator import CACHE_DIR

    return set(CACHE_DIR.rglob("*.nbc"))


def mark_of(what: str) -> Path:
    """Returns the mark file, which exists once an earlier start has compiled all that this one needs."""
    from estimator import CACHE_DIR

    # the directory is named by the sources' content; a disk may be put into a computer with another processor
    key = os.environ.get("NUMBA_CPU_NAME") or _processor()
    return CACHE_DIR / f"{what}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"


def _processor() -> str:
    """Returns type and features of the first processor as Linux lists them (proc(5)): more than the compiler uses."""
    try:
        first = CPUINFO.read_text().partition("\n\n")[0]
    except OSError:  # an unknown processor; numba's own key still tells processors apart
        return ""
    return "\n".join(line for line in first.splitlines() if line.partition("\t")[0].partition(":")[0].strip() in MAKE)


def is_marked(what: str) -> bool:
    """True if the mark file and kernels exist; a clean-up of the disk may delete the kernels, which are large.

    A mark shows that a start has compiled everything, and not that each file is still good: only loading does.
    """
    try:
        return mark_of(what).exists() and bool(_compiled())
    except OSError:  # what cannot be read is compiled
        return False


def _what(lights: bool) -> str:
    """Returns the name of the set of kernels for a start of the daemon, with or without lights."""
    return "warm-lights" if lights else "warm"


def is_warm(lights: bool) -> bool:
    """True if an earlier start has compiled everything, with or without lights; loads none of it.

    Raises:
        CannotLoad: there is no folder for compiled kernels.
    """
    try:
        return is_marked(_what(lights))
    except (OSError, RuntimeError) as error:
        raise CannotLoad(f"kernels cannot be loaded: {error}") from error


def _load(begun: float, lights: Lights | None) -> Warmth:
    from estimator import CACHE_DIR, CACHE_REPORT

    what = _what(lights is not None)
    with KernelLock(CACHE_DIR) as lock:
        compiled = False
        if not is_marked(what):
            lock.acquire()
            compiled = not is_marked(what)  # the previous holder of the lock may have compiled them all
        cold = compiled
        if cold:
            count = kernel_count(lights is not None)
            log.info(
                "first start of this version: the daemon compiles up to %d kernels (a minute or two)",
                count,
            )
        before = len(CACHE_REPORT.damaged)

        def missing() -> None:
            """Takes the lock when a kernel is missing despite the mark."""
            nonlocal compiled
            lock.acquire()
            compiled = True

        with _uncollected(not cold), before_compiling(missing):
            _exercise()
            code_us = 0.0 if lights is None else _exercise_lights(lights)
        if cold:
            _mark(what)
    damaged = len(CACHE_REPORT.damaged) - before
    return Warmth(compiled, time.monotonic() - begun, code_us, damaged, CACHE_REPORT.unwritten)


def _mark(what: str) -> None:
    """Writes the mark file, after the names of all compiled kernels have been synced to the disk.

    A mark that cannot be written costs the next start a search for missing kernels, and nothing else.
    """
    from estimator import CACHE_DIR, CACHE_REPORT

    if CACHE_REPORT.unwritten:
        return
    try:
        for folder in (CACHE_DIR, *{path.parent for path in _compiled()}):
            sync_folder(folder)
        write_whole(mark_of(what), b"")
    except OSError as error:
        log.warning("%s cannot be written: %s", mark_of(what), error.strerror)


@contextlib.contextmanager
def _uncollected(wanted: bool) -> Iterator[None]:
    """Context without garbage collection: it takes a fifth of the loading time and frees little.

    Compiling leaves much to free.
    """
    collects = gc.isenabled()
    if wanted:
        gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def kernel_count(lights: bool = False) -> int:
    """Number of kernels that the first start compiles, with or without lights; inlined ones do not count."""
    left_out = OFFLINE if lights else OFFLINE + LIGHT
    files = (path for path in ROOM.rglob("*.py"))
    paths = (path for path in files if not {path.stem, path.parent.name} & set(left_out))
    heads = (text.partition("\ndef ")[0] for path in paths for text in path.read_text().split("\n@kernel(")[1:])
    return sum("inline=True" not in head for head in heads)


def _exercise() -> None:
    """Makes two steps with a small scan, so that first-use imports and allocations precede the first cycle."""
    import numpy as np

    from estimator import UNLIMITED, Scan, new_state, step

    state = new_state()
    bearing = np.linspace(-2.0, 2.0, 100)
    reach = 2.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing)))
    hit = np.ones(100, dtype=np.uint8)
    for seq in range(2):
        step(state, [Scan(seq * 0.1, seq * 0.1 + 0.05, seq, np.zeros(3), bearing, reach, hit, 0.01)], UNLIMITED)


def _exercise_lights(lights: Lights) -> float:
    """Makes steps with light; returns the cost of the search for one code on this computer, us."""
    import numpy as np

    from daemon.maps.initial_state import new_state
    from estimator import UNLIMITED, SampleBlock, decode, new_decoder, search, step

    profile, state = lights.profile, new_state(lights)
    words = np.round(2000.0 + 500.0 * np.sin(0.9 * np.arange(round(profile.epoch_s * profile.sample_rate)) ** 1.1))
    blocks = [
        SampleBlock(turn * profile.epoch_s, (turn + 1) * profile.epoch_s, words, profile.sample_rate)
        for turn in range(TIMED_TURNS)
    ]
    for block in blocks[:2]:
        step(state, [block], UNLIMITED)
    decoder = new_decoder(profile, 0.0)
    decode(decoder, blocks[0])
    search(decoder, TIMED_CODES)  # the first call makes the spectra of the codes
    best = float("inf")
    for block in blocks[1:]:
        decode(decoder, block)
        begun = time.perf_counter()
        search(decoder, TIMED_CODES)
        best = min(best, time.perf_counter() - begun)
    return 1e6 * best / TIMED_CODES


def _progress_line(seconds: float, lights: bool = False) -> str:
    """Returns the progress of compiling after ``seconds``, or what it waits for; empty until the compiler is loaded."""
    kernel = sys.modules.get("estimator.numerics.jit_cache")
    directory: Path | None = getattr(kernel, "CACHE_DIR", None)
    if directory is None:
        return ""
    if waits.is_set():
        return f"waiting for another process that compiles kernels, after {seconds:.0f} s"
    since = time.time() - seconds
    try:
        count = sum(path.stat().st_mtime >= since for path in directory.rglob("*.nbc"))
    except OSError:  # another process has just removed it, or the disk fails
        return ""
    if count == 0:
        return f"still loading the estimator after {seconds:.0f} s"
    total = kernel_count(lights)  # kernels of other parts of the program may have been compiled too
    return f"compiling: {min(count, total)} of {total} kernels after {seconds:.0f} s"
