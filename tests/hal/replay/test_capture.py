"""Raw captures of a serial line."""

import struct
from pathlib import Path

import pytest

from hal.errors import DataInvalid, DeviceMissing
from hal.replay.capture import Chunk, looks_like_capture, read_capture
from hal.replay.report import LogReport

CHUNKS = [Chunk(10_757, b"V"), Chunk(10_762, b"V\n00P"), Chunk(1_000_000, b"\n\n")]


def pack(chunks: list[Chunk]) -> bytes:
    return b"".join(struct.pack(">QI", c.t_us, len(c.data)) + c.data for c in chunks)


def test_reads_what_was_captured(tmp_path: Path) -> None:
    path = tmp_path / "a.logr"
    path.write_bytes(pack(CHUNKS))
    report = LogReport()
    assert read_capture(path, report) == CHUNKS
    assert report.used == {"chunks": 3, "bytes": 8}


def test_a_host_clock_that_was_set_or_stands_still(tmp_path: Path) -> None:
    true = [10_000 * i for i in range(200)]
    path, report = tmp_path / "a.logr", LogReport()
    path.write_bytes(pack([Chunk(t - (700_000 if t > 1_000_000 else 0) + 10**9, b"x") for t in true]))
    assert [chunk.t_us - 10**9 for chunk in read_capture(path, report)] == pytest.approx(true, abs=2)
    assert any("clock was set" in note for note in report.notes)
    path.write_bytes(pack([Chunk(7, b"x")] * 200))
    with pytest.raises(DataInvalid, match="all 200 times in it are equal"):
        read_capture(path, LogReport())


@pytest.mark.parametrize("cut", range(1, 12))
def test_a_torn_end_costs_the_last_chunk(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.logr"
    path.write_bytes(pack(CHUNKS)[:-cut])
    report = LogReport()
    assert read_capture(path, report) == CHUNKS[:2]
    assert report.skipped


def test_bytes_that_are_no_record_end_it(tmp_path: Path) -> None:
    path = tmp_path / "a.logr"
    path.write_bytes(pack(CHUNKS) + b"FLASER 180 1.0 1.0")
    report = LogReport()
    assert read_capture(path, report) == CHUNKS
    assert "not a record" in report.sentences()[0]


@pytest.mark.parametrize("content", [b"", b"FLASER 180 1.0 1.0 1.0", b"\x1f\x8b\x08 gzip data here", b"\0" * 40])
def test_what_is_no_capture_is_refused(tmp_path: Path, content: bytes) -> None:
    assert not looks_like_capture(content)
    path = tmp_path / "a.logr"
    path.write_bytes(content)
    with pytest.raises(DataInvalid, match=r"a\.logr"):
        read_capture(path, LogReport())


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissing):
        read_capture(tmp_path / "a.logr", LogReport())


def test_the_real_dialogue_is_read_to_its_last_byte(log_root: Path) -> None:
    for name, first in (("example_urg_04lx.logr", b"VV\n00P\nVEND:Hokuyo"), ("example_urg_04lx.logw", b"VV\n")):
        path, report = log_root / "scip" / name, LogReport()
        chunks = read_capture(path, report)
        data = b"".join(chunk.data for chunk in chunks)
        assert data.startswith(first)
        assert len(data) == path.stat().st_size - 12 * len(chunks)
        assert not report.skipped


def test_a_capture_that_ends_within_its_first_record_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.logr").write_bytes(struct.pack(">QI", 1_000_000, 100) + b"too few")
    with pytest.raises(DataInvalid, match="within its first record"):
        read_capture(tmp_path / "a.logr", LogReport())
