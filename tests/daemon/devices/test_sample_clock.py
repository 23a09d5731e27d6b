"""The stored sample clock: kept for its converter; passed over where it is missing, damaged or cannot be written."""

import json
import logging
import threading
from pathlib import Path

import pytest

from daemon.config.paths import state_folder
from daemon.config.schema import PhotodiodeConfig
from daemon.devices import sample_clock
from daemon.devices.sample_clock import FILE, MOVED_PPM, SampleClock
from daemon.system.atomic_file import write_whole

CONFIG = PhotodiodeConfig(bus="/dev/i2c-1")
OTHER = PhotodiodeConfig(bus="/dev/i2c-1", converter="adc121c021@0x54")


def learned(clock: SampleClock, ppm: float | None) -> SampleClock:
    """Once it has taken that in and the thread has come back."""
    clock.learn(ppm)
    clock.close()
    return clock


def test_what_was_found_is_there_at_the_next_start(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    first = SampleClock(CONFIG, folder)
    assert first.ppm is None
    learned(first, None)
    assert not folder.exists(), "there is nothing to keep yet"
    learned(first, -3210.04)
    learned(SampleClock(OTHER, folder), 55.5)
    assert SampleClock(CONFIG, folder).ppm == -3210.0
    assert SampleClock(OTHER, folder).ppm == 55.5, "each converter has its own"
    assert [path.name for path in folder.iterdir()] == [FILE]


def test_it_is_written_only_when_it_is_news(tmp_path: Path) -> None:
    clock = learned(SampleClock(CONFIG, tmp_path), 100.0)
    written = (tmp_path / FILE).read_text()
    learned(clock, 100.0 + 0.9 * MOVED_PPM)
    assert (tmp_path / FILE).read_text() == written
    learned(clock, 100.0 + 1.1 * MOVED_PPM)
    assert (tmp_path / FILE).read_text() != written


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[1, 2]",
        b"7",
        b"\xff\xfe",
        b'{"/dev/i2c-1 mcp3221@0x4d A": "x"}',
        b'{"/dev/i2c-1 mcp3221@0x4d A": []}',
        b'{"/dev/i2c-1 mcp3221@0x4d A": ' + 400 * b"1" + b"}",
        100_000 * b"[",
    ],
)
def test_a_damaged_file_is_said_and_replaced(tmp_path: Path, text: bytes, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / FILE).write_bytes(text)
    clock = SampleClock(CONFIG, tmp_path)
    assert clock.ppm is None
    assert "is damaged and ignored" in caplog.text
    learned(clock, 12.0)
    assert json.loads((tmp_path / FILE).read_text()) == {"/dev/i2c-1 mcp3221@0x4d A": 12.0}


@pytest.mark.parametrize("ppm", ["NaN", "1e9", "-10001"])
def test_a_clock_that_cannot_be_is_not_believed(tmp_path: Path, ppm: str) -> None:
    (tmp_path / FILE).write_text(f'{{"/dev/i2c-1 mcp3221@0x4d A": {ppm}}}')
    clock = SampleClock(CONFIG, tmp_path)
    assert clock.ppm is None
    assert learned(clock, float(ppm)).ppm is None


def test_a_place_that_cannot_be_written_is_said_once_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sample_clock, "RETRY_S", 0.0)
    caplog.set_level(logging.WARNING)
    file = tmp_path / "file"
    file.write_text("")
    clock = SampleClock(CONFIG, file)
    caplog.clear()
    for ppm in (100.0, 200.0, 300.0):
        learned(clock, ppm)
    assert clock.ppm == 300.0
    assert len([record for record in caplog.records if "cannot store" in record.message]) == 1
    file.unlink()
    learned(clock, 300.0)
    assert SampleClock(CONFIG, file).ppm == 300.0, "though nothing is new"


def test_a_disk_that_hangs_holds_nobody_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hanging = threading.Event()

    def hang(path: Path, content: bytes) -> None:
        hanging.wait()
        write_whole(path, content)

    monkeypatch.setattr(sample_clock, "write_whole", hang)
    monkeypatch.setattr(sample_clock, "CLOSE_S", 0.01)
    clock, threads = SampleClock(CONFIG, tmp_path), threading.active_count()
    for ppm in (100.0, 200.0, 300.0):
        learned(clock, ppm)
    assert threading.active_count() == threads + 1
    hanging.set()
    monkeypatch.setattr(sample_clock, "CLOSE_S", 5.0)
    clock.close()
    assert learned(clock, None).ppm == 300.0
    assert SampleClock(CONFIG, tmp_path).ppm == 300.0


def test_a_thread_that_cannot_be_had_is_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def none_left(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", none_left)
    learned(SampleClock(CONFIG, tmp_path), 100.0)
    assert "can't start new thread" in caplog.text


@pytest.mark.parametrize(
    ("environment", "folder"),
    [
        ({"STATE_DIRECTORY": "/var/lib/lumiloop:/var/lib/x", "HOME": "/root"}, "/var/lib/lumiloop"),
        ({"XDG_STATE_HOME": "/home/a/state", "HOME": "/home/a"}, "/home/a/state/lumiloop"),
        ({"HOME": "/home/a"}, "/home/a/.local/state/lumiloop"),
        ({}, "/.local/state/lumiloop"),
    ],
)
def test_where_it_is_kept(environment: dict[str, str], folder: str) -> None:
    assert state_folder(environment) == Path(folder)
