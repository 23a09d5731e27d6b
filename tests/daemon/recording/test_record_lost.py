"""How much of a recording a kill or a power cut costs, at the writing thread's own pace, in time of the test's own."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from daemon.recording import disk_writer
from daemon.recording.disk_writer import SegmentWriter
from hal.replay.recording import Kind, pack_frame


class Moments(threading.Event):
    """In the place of what the writing thread waits for: time goes by in steps, and each step brings a record."""

    def __init__(self, steps: int, step: Callable[[float], None]) -> None:
        super().__init__()
        self.now, self.left, self.step = 0.0, steps, step

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        for _ in range(round(timeout / 0.01)):
            self.now, self.left = self.now + 0.01, self.left - 1
            self.step(self.now)
        return self.left <= 0


class Unhurried(SegmentWriter):
    """Its thread ends at once, for another to do its work."""

    def _work(self) -> None:
        if isinstance(self._stop, Moments):
            super()._work()


def test_at_any_moment_all_but_half_a_second_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In time of its own: a kill costs what is not written, a power cut what is not synced."""
    out = Unhurried(tmp_path, "run", {"recording": "x"})
    path = next(out.folder.iterdir())
    head, each = path.stat().st_size, len(pack_frame(Kind.RX, 0, 0.0, bytes(8)))
    handed: list[float] = []
    synced, unwritten, unsynced = 0, [], []

    def sync(file: int) -> None:
        nonlocal synced
        synced = (os.fstat(file).st_size - head) // each

    def step(now: float) -> None:
        written = (path.stat().st_size - head) // each
        unwritten.append(now - ([*handed, now])[written])
        unsynced.append(now - ([*handed, now])[synced])
        handed.append(now)
        out.put(Kind.RX, 0, now, bytes(8))

    moments = Moments(1000, step)
    out._thread.join()
    out._stop = moments
    out._synced_at = 0.0
    monkeypatch.setattr(disk_writer, "time", SimpleNamespace(monotonic=lambda: moments.now))
    monkeypatch.setattr(disk_writer.os, "fdatasync", sync)
    out._work()
    assert len(handed) == synced == 1000, "and nothing is left at the end"
    assert max(unwritten) <= 0.1 + 1e-9
    assert 0.3 < max(unsynced) <= 0.5 + 1e-9
