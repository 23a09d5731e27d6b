"""Kernels whose files are damaged, locked or cannot be stored: every start comes to its end, and says what it did."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.runtime import warmup
from daemon.system import kernel_lock
from daemon.system.kernel_lock import KernelLock
from estimator.numerics.jit_cache_file import CACHE_REPORT, note_unwritten
from tests.daemon.runtime.test_warmup import LOAD, ROOT, another_compiles, kernels_copied
from tests.daemon.support.odd_files import KINDS, planted


@pytest.mark.jit
def test_a_start_with_damaged_kernels_compiles_those_and_says_so_once(tmp_path: Path) -> None:
    """As a power cut leaves them; the mark says that all are good."""
    warmup.load()
    folder = kernels_copied(tmp_path)
    min(folder.glob("scan_matching_*/deskew.*.nbc")).write_bytes(b"")
    for index in folder.glob("scan_matching_*/icp.*.nbi"):
        index.write_bytes(index.read_bytes()[:20])
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    words = [sys.executable, "-c", LOAD.replace("compiled)", "damaged)")]
    first, second = (
        subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120.0) for _ in "12"
    )
    assert int(first.stdout) >= 2, first.stderr
    assert first.stderr.count("cannot be used") == 1
    assert (second.stdout, second.stderr) == ("0\n", "")


@pytest.mark.parametrize("kind", KINDS)
def test_a_lock_that_cannot_be_taken_is_done_without(tmp_path: Path, kind: str) -> None:
    planted(tmp_path / "lock", kind)
    with KernelLock(tmp_path) as lock:
        lock.acquire()


def test_nobody_waits_for_ever_for_another_that_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(kernel_lock, "MOST_S", 0.3)
    with another_compiles(tmp_path), KernelLock(tmp_path) as lock:
        lock.acquire()
    assert "is still held after 0 s" in caplog.text


def test_a_mark_is_written_once_the_names_of_all_kernels_are_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[Path] = []
    monkeypatch.setattr("estimator.CACHE_DIR", tmp_path)
    monkeypatch.setattr(warmup, "_exercise", lambda: (tmp_path / "part").mkdir() or (tmp_path / "part/a.nbc").touch())
    monkeypatch.setattr(warmup, "sync_folder", order.append)
    monkeypatch.setattr(warmup, "write_whole", lambda path, content: order.append(path))
    assert warmup.load().compiled
    assert set(order[:-1]) == {tmp_path, tmp_path / "part"}
    assert order[-1] == warmup.mark_of("warm")


def test_kernels_that_could_not_be_stored_leave_no_mark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(CACHE_REPORT, "unwritten", "")
    monkeypatch.setattr("estimator.CACHE_DIR", tmp_path)
    monkeypatch.setattr(warmup, "_exercise", lambda: [note_unwritten("/k: No space left on device") for _ in "12"])
    assert warmup.load().unwritten == "/k: No space left on device"
    assert not warmup.mark_of("warm").exists()
    assert caplog.text.count("compiled kernels cannot be stored, so each start") == 1


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ImportError("libLLVM.so: failed to map segment from shared object: Cannot allocate memory"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
    ],
    ids=repr,
)
def test_a_memory_limit_is_named_as_such(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(warmup, "_load", fails)
    with pytest.raises(warmup.CannotLoad, match="not enough memory"):
        warmup.load()
