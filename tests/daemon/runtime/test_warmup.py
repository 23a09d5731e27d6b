"""Warm-up: beside the loop, with progress, under a lock, and no longer than it has to be."""

import asyncio
import fcntl
import gc
import os
import random
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from daemon.devices.light_setup import Lights
from daemon.runtime import warmup
from daemon.runtime.warmup import Warmth, kernel_count, warm_up
from daemon.system.kernel_lock import KernelLock, waits
from estimator.cdma.air_interface import PROFILE_A
from estimator.light_filter.survey import Survey
from estimator.numerics.jit_cache import CACHE_DIR

ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def _unfrozen() -> object:
    yield None
    gc.unfreeze()


def test_the_loop_goes_on_while_the_estimator_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()

    def slow() -> Warmth:
        release.wait(10.0)
        return Warmth(compiled=True, seconds=12.3)

    monkeypatch.setattr(warmup, "load", slow)
    monkeypatch.setattr(warmup, "REPORT_S", 0.02)
    lines: list[str] = []

    async def go() -> Warmth:
        third = asyncio.Event()

        def progress(line: str) -> None:
            lines.append(line)
            if len(lines) == 3:
                third.set()

        warming = asyncio.create_task(warm_up(progress))
        await third.wait()
        release.set()
        return await warming

    assert asyncio.run(asyncio.wait_for(go(), 10.0)).compiled
    assert lines[0].startswith("still loading the estimator after")
    assert lines[-1].startswith("kernels compiled in 12 s")


def test_a_failure_to_load_is_raised_not_swallowed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> Warmth:
        raise RuntimeError("no writable directory for compiled kernels")

    monkeypatch.setattr(warmup, "load", fail)
    with pytest.raises(RuntimeError, match="no writable directory"):
        asyncio.run(warm_up())


def test_a_machine_on_which_nothing_can_be_kept_gets_a_clear_refusal() -> None:
    code = "from daemon.cli.parser import main; raise SystemExit(main(['run', '--set', 'modbus.port=0']))"
    nowhere = {"NUMBA_CACHE_DIR": "/proc/nowhere", "HOME": "/proc/nowhere", "TMPDIR": "/proc/nowhere"}
    environment = {key: value for key, value in os.environ.items() if key not in ("XDG_CACHE_HOME", "CACHE_DIRECTORY")}
    command = [sys.executable, "-c", f"import tempfile; tempfile.tempdir = '/proc/nowhere'; {code}"]
    done = subprocess.run(
        command, cwd=ROOT, env=environment | nowhere, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 1
    assert "no writable directory for compiled kernels; set NUMBA_CACHE_DIR to one" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_stop_does_not_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()
    monkeypatch.setattr(warmup, "load", lambda: release.wait(30.0) and Warmth(False, 0.0))

    async def go() -> None:
        warming = asyncio.create_task(warm_up())
        await asyncio.sleep(0.05)
        warming.cancel()

    begun = time.monotonic()
    asyncio.run(go())
    assert time.monotonic() - begun < 5.0
    release.set()


def test_warm_means_loaded_frozen_and_quick() -> None:
    first = warmup.load()
    again = warmup.load()
    assert not again.compiled
    assert again.seconds <= max(1.0, first.seconds)
    asyncio.run(warm_up())
    assert gc.get_freeze_count() > 1000


LOAD = (
    "import logging; logging.basicConfig(level=logging.INFO, format='%(message)s')\n"
    "from daemon.runtime import warmup; print(warmup.load().compiled)"
)


@contextmanager
def another_compiles(folder: Path) -> Iterator[None]:
    """As if another process did."""
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def test_a_start_whose_kernels_are_there_waits_for_nobody() -> None:
    """Whoever compiles: for a copy of these sources elsewhere, or for a command that needs others."""
    warmup.load()
    with another_compiles(CACHE_DIR):
        done = subprocess.run([sys.executable, "-c", LOAD], cwd=ROOT, capture_output=True, text=True, timeout=60.0)
    assert done.stdout == "False\n"
    assert done.stderr == ""


def kernels_copied(root: Path) -> Path:
    """The kernels of this tree with their mark, below another cache root."""
    folder = root / CACHE_DIR.name
    for package in CACHE_DIR.glob("*_estimator"):
        shutil.copytree(package, folder / package.name)
    shutil.copy(warmup.mark_of("warm"), folder)
    return folder


@pytest.mark.jit
def test_a_start_of_which_one_kernel_is_missing_waits_before_it_compiles_it(tmp_path: Path) -> None:
    """The mark says that all are there: nothing is written beside somebody who compiles, nor is half a file read."""
    warmup.load()
    folder = kernels_copied(tmp_path)
    missing = min(folder.glob("scan_matching_*/deskew.*.nbc"))
    missing.unlink()
    half = missing.with_name(f"{missing.name}.tmp.0123456789abcdef")
    half.write_bytes(b"of somebody who compiles")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    words, pipe = [sys.executable, "-c", LOAD], subprocess.PIPE
    with another_compiles(folder):
        second = subprocess.Popen(words, cwd=ROOT, env=environment, stdout=pipe, stderr=pipe, text=True)
        assert second.stderr is not None
        assert "waiting for another process that compiles" in second.stderr.readline()
        with pytest.raises(subprocess.TimeoutExpired):
            second.communicate(timeout=0.5)
        assert not missing.exists()
    output, rest = second.communicate(timeout=120.0)
    assert output == "True\n", rest
    assert missing.exists()


def test_a_first_start_waits_for_another_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("estimator.CACHE_DIR", tmp_path)
    monkeypatch.setattr(warmup, "_exercise", lambda: None)
    caplog.set_level("INFO")
    with ThreadPoolExecutor(1) as pool:
        with another_compiles(tmp_path):
            loading = pool.submit(warmup.load)
            assert waits.wait(10.0)
            assert warmup._progress_line(12.0) == "waiting for another process that compiles kernels, after 12 s"
            (tmp_path / "one.nbc").touch()
            warmup.mark_of("warm").touch()  # it has compiled all of them
            assert not loading.done()
        assert not loading.result(10.0).compiled
    assert not waits.is_set()
    assert f"it holds {tmp_path / 'lock'}" in caplog.text


@pytest.mark.usefixtures("warm_kernels")
@pytest.mark.parametrize("lit", [False, True])
def test_a_start_loads_nothing_it_does_not_use(lit: bool) -> None:
    """scipy alone would cost a third of a warm start and 17 MB; it is there for work that is not done at the start."""
    overrides = ("photodiode.bus=/dev/i2c-1",) if lit else ()
    code = (
        "import sys; import daemon.app; from daemon.runtime import warmup\n"
        "from daemon.config.loader import load; from daemon.devices.light_setup import load_lights\n"
        f"warmth = warmup.load(load_lights(load(None, {overrides}))); assert (warmth.code_us > 0) is {lit}\n"
        "print(warmth.compiled)\n"
        "heavy = {'scipy.linalg', 'scipy.sparse', 'scipy.spatial', 'pymodbus.server', 'serial', 'matplotlib'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    for _ in range(2):  # the first may compile, which looks for scipy in a way of its own
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["False", "[]"]


def test_progress_counts_what_was_compiled_since_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("estimator.numerics.jit_cache.CACHE_DIR", tmp_path)
    old = tmp_path / "old.nbc"
    old.touch()
    os.utime(old, (time.time() - 1000.0,) * 2)
    assert warmup._progress_line(10.0) == "still loading the estimator after 10 s"
    (tmp_path / "new.nbc").touch()
    assert warmup._progress_line(10.0) == f"compiling: 1 of {kernel_count()} kernels after 10 s"
    for k in range(kernel_count() + 5):
        (tmp_path / f"{k}.nbc").touch()
    assert warmup._progress_line(10.0) == f"compiling: {kernel_count()} of {kernel_count()} kernels after 10 s"


def test_there_are_kernels_to_count() -> None:
    assert kernel_count() >= 5


@pytest.mark.slow
def test_the_first_start_ever_says_that_it_compiles_and_how_long(tmp_path: Path) -> None:
    code = (
        "import asyncio, logging; logging.basicConfig(level=logging.INFO, format='%(message)s')\n"
        "from daemon.runtime.warmup import warm_up; print(asyncio.run(warm_up()))"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    texts = []
    for _ in range(2):
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
        texts.append(done.stdout + done.stderr)
    assert "compiled=True" in texts[0]
    assert f"the daemon compiles up to {kernel_count()} kernels" in texts[0]
    assert "kernels compiled in" in texts[0]
    assert "compiled=False" in texts[1]
    assert "compil" not in texts[1].replace("compiled=False", "")


def test_with_a_photodiode_the_cost_of_the_search_is_measured() -> None:
    warmth = warmup.load(Lights(Survey(), PROFILE_A))
    assert 0.5 < warmth.code_us < 2000.0
    assert warmup.load().code_us == 0.0


def test_a_start_without_a_photodiode_loads_nothing_of_light() -> None:
    code = (
        "import sys; import daemon.app\n"
        "assert 'numba' not in sys.modules, 'kernels are loaded beside the loop'\n"
        "from daemon.runtime import warmup; warmup.load()\n"
        "light = {'estimator.cdma.decoder', 'hal.photodiode.driver', 'hal.bus.i2c_thread',"
        " *('estimator.light_filter.' + name for name in ('light_channel', 'light_filter'))}\n"
        "print(sorted(light & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_kernels_of_light_are_counted_only_where_there_is_a_photodiode() -> None:
    assert kernel_count() < kernel_count(lights=True)


def test_a_command_says_once_that_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmup, "mark_of", lambda what: tmp_path / what)
    monkeypatch.setattr(warmup, "LOOK_S", 0.002)
    kernels: set[Path] = {Path("of another part")}
    monkeypatch.setattr(warmup, "_compiled", lambda: set(kernels))
    first = threading.Event()
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        first.set()

    def work() -> None:
        kernels.add(Path("made"))
        assert first.wait(5.0), "said before it is done"

    for _ in range(2):
        warmup.load_aloud(say, "warm", work)
    assert said[0].startswith("compiling numerical kernels, once for each version")
    assert said[1].startswith("kernels compiled: 1, in 0 s")
    assert len(said) == 2


def test_a_command_whose_kernels_are_there_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmup, "mark_of", lambda what: tmp_path / what)
    monkeypatch.setattr(warmup, "LOOK_S", 0.002)
    said: list[str] = []
    warmup.load_aloud(said.append, "export", lambda: time.sleep(0.02))
    assert said == []
    assert (tmp_path / "export").exists()


def test_a_command_that_cannot_load_leaves_no_mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warmup, "mark_of", lambda what: tmp_path / what)

    def full() -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(warmup.CannotLoad, match="No space left"):
        warmup.load_aloud(lambda text: None, "warm", full)
    assert not (tmp_path / "warm").exists()


def test_what_a_command_compiles_beyond_the_daemons_kernels_it_compiles_under_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []
    monkeypatch.setattr(warmup, "mark_of", lambda what: tmp_path / what)
    monkeypatch.setattr("estimator.CACHE_DIR", tmp_path)
    monkeypatch.setattr(KernelLock, "acquire", lambda lock: taken.append("taken"))
    (tmp_path / "of_its_own.py").write_text("import numba\nnumba.njit('f8(f8)')(lambda x: x + 1.0)\n")
    monkeypatch.syspath_prepend(tmp_path)
    warmup.load_aloud(lambda text: None, "plan", lambda: taken.append("loaded"), "of_its_own")
    assert taken[:2] == ["loaded", "taken"]


def test_a_lock_of_another_user_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(13, "Permission denied", "/var/cache/lumiloop/lock")

    monkeypatch.setattr(warmup, "_load", refused)
    with pytest.raises(warmup.CannotLoad, match=r"/var/cache/lumiloop/lock.*give this user write access to that file"):
        warmup.load()


def test_warm_loads_what_an_earlier_start_has_compiled() -> None:
    """A mark says that they were good, and only loading that they still are."""
    warmup.load()
    code = (
        "import sys; from daemon.cli.parser import main\n"
        "assert main(['warm', '--set', 'modbus.port=0']) == 0\n"
        "print('estimator.pipeline' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
    assert done.stderr.startswith("lumiloop: the kernels were compiled before; they load in ")


def test_a_mark_without_kernels_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who makes room on the disk deletes what is large: the kernels, and not the mark."""
    monkeypatch.setattr("estimator.CACHE_DIR", tmp_path)
    monkeypatch.setattr(warmup, "_exercise", lambda: None)
    worked: list[str] = []
    for what in ("warm", "export"):
        warmup.mark_of(what).touch()
    assert not warmup.is_warm(lights=False)
    assert warmup.load().compiled
    warmup.load_aloud(lambda text: None, "export", lambda: worked.append("export"))
    assert worked == ["export"]
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "one.nbc").touch()
    assert warmup.is_warm(lights=False)
    assert not warmup.load().compiled
    warmup.load_aloud(lambda text: None, "export", lambda: worked.append("again"))
    assert worked == ["export"]


def other_processor(folder: Path, name: str) -> Path:
    path = folder / name
    path.write_text(f"processor\t: 0\nmodel name\t: {name}\ncpu MHz\t\t: {random.random()}\n\nprocessor\t: 1\n")
    return path


def test_another_processor_s_kernels_are_none_of_this_one_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = warmup.mark_of("warm")
    assert warmup.mark_of("warm") == ours
    monkeypatch.setattr(warmup, "CPUINFO", other_processor(tmp_path, "another"))
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    assert warmup.mark_of("warm") != ours
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert warmup.mark_of("warm") != ours
    monkeypatch.setattr(warmup, "CPUINFO", other_processor(tmp_path, "a third"))
    generic = warmup.mark_of("warm")
    monkeypatch.undo()
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert warmup.mark_of("warm") == generic


def test_garbage_is_looked_for_while_kernels_are_compiled_and_not_while_they_are_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collects: list[bool] = []
    monkeypatch.setattr(warmup, "mark_of", lambda what: tmp_path / what)
    monkeypatch.setattr(warmup, "_exercise", lambda: collects.append(gc.isenabled()))
    for _ in range(2):
        warmup.load()
    assert collects == [True, False]
    assert gc.isenabled()
