"""The stored sample clock: kept for its converter; passed over where it is missing, damaged or cannot be written."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from daemon.config import PhotodiodeConfig
from daemon.folders import state_folder
from daemon.sampleclock import FILE, MOVED_PPM, SampleClock

CONFIG = PhotodiodeConfig(bus="/dev/i2c-1")
OTHER = PhotodiodeConfig(bus="/dev/i2c-1", converter="adc121c021@0x54")


def test_what_was_found_is_there_at_the_next_start(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    first = SampleClock(CONFIG, folder)
    assert first.ppm is None
    first.learn(None)
    assert not folder.exists(), "there is nothing to keep yet"
    first.learn(-3210.04)
    SampleClock(OTHER, folder).learn(55.5)
    assert SampleClock(CONFIG, folder).ppm == -3210.0
    assert SampleClock(OTHER, folder).ppm == 55.5, "each converter has its own"
    assert [path.name for path in folder.iterdir()] == [FILE]


def test_it_is_written_only_when_it_is_news(tmp_path: Path) -> None:
    clock = SampleClock(CONFIG, tmp_path)
    clock.learn(100.0)
    written = (tmp_path / FILE).read_text()
    clock.learn(100.0 + 0.9 * MOVED_PPM)
    assert (tmp_path / FILE).read_text() == written
    clock.learn(100.0 + 1.1 * MOVED_PPM)
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
    ],
)
def test_a_damaged_file_is_said_and_replaced(tmp_path: Path, text: bytes, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / FILE).write_bytes(text)
    clock = SampleClock(CONFIG, tmp_path)
    assert clock.ppm is None
    assert "is damaged and passed over" in caplog.text
    clock.learn(12.0)
    assert json.loads((tmp_path / FILE).read_text()) == {"/dev/i2c-1 mcp3221@0x4d A": 12.0}


@pytest.mark.parametrize("ppm", ["NaN", "1e9", "-10001"])
def test_a_clock_that_cannot_be_is_not_believed(tmp_path: Path, ppm: str) -> None:
    (tmp_path / FILE).write_text(f'{{"/dev/i2c-1 mcp3221@0x4d A": {ppm}}}')
    clock = SampleClock(CONFIG, tmp_path)
    assert clock.ppm is None
    clock.learn(float(ppm))
    assert clock.ppm is None


def test_a_place_that_cannot_be_written_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    (tmp_path / "file").write_text("")
    clock = SampleClock(CONFIG, tmp_path / "file")
    caplog.clear()
    for ppm in (100.0, 200.0, 300.0):
        clock.learn(ppm)
    assert clock.ppm == 300.0
    assert len([record for record in caplog.records if "cannot be kept" in record.message]) == 1


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
