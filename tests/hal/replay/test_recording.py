"""The recording's format: what was written is read, and damage costs only what it hit."""

import struct
import time
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.errors import DataInvalid, DeviceMissing
from hal.imu import RawImu
from hal.odometry import RawOdometry
from hal.replay.recording import (
    HEAD,
    LONGEST,
    MAGIC,
    MARKER,
    VERSION,
    Frame,
    Kind,
    Recording,
    header_of,
    open_recording,
    pack_frame,
    pack_head,
    pack_imu,
    pack_odometry,
    segment_name,
    unpack_imu,
    unpack_odometry,
)
from hal.replay.report import LogReport

FRAMES = [Frame(Kind.RX, 0, 1.0 + i, bytes([i]) * (i * 7) + MARKER) for i in range(20)]


def pack(frames: list[Frame]) -> bytes:
    return b"".join(pack_frame(f.kind, f.channel, f.t_mono, f.payload) for f in frames)


def head(segment: int = 0, recording: str = "a") -> bytes:
    return pack_head({"recording": recording, "segment": segment})


def read(path: Path) -> tuple[list[Frame], LogReport]:
    report = LogReport()
    return list(open_recording(path).frames(report)), report


def write(folder: Path, *segments: bytes) -> Path:
    for number, data in enumerate(segments):
        (folder / segment_name(number)).write_bytes(data)
    return folder


def test_written_and_read(tmp_path: Path) -> None:
    write(tmp_path, head(0) + pack(FRAMES[:12]), head(1) + pack(FRAMES[12:]))
    frames, report = read(tmp_path)
    assert frames == FRAMES
    assert report.used == {"rx": 20}
    assert not report.sentences()
    alone, report = read(tmp_path / segment_name(1))
    assert alone == FRAMES[12:]
    assert report.sentences() == ["000001.lumirec: the previous segment is missing"]


def test_the_format_is_what_its_description_says() -> None:
    """Byte by byte, so that a change of the format is noticed (and gets a new version)."""
    frame = pack_frame(Kind.TX, 3, 2.0, b"VV\n")
    assert frame == bytes.fromhex("a55a0203030000000000000000000040") + struct.pack("<I", 0xDA77A602) + b"VV\n"
    assert head().startswith(b"LUMIREC\n\x02\x00")


@pytest.mark.parametrize("cut", [1, 5, 19, 20, 21, 60])
def test_a_torn_end_costs_the_last_record_only(tmp_path: Path, cut: int) -> None:
    data = head() + pack(FRAMES)
    write(tmp_path, data[:-cut])
    frames, report = read(tmp_path)
    whole = len(FRAMES) - 1
    while len(pack(FRAMES[:whole])) + len(head()) > len(data) - cut:
        whole -= 1
    assert frames == FRAMES[:whole]
    said = report.sentences()
    assert (not said) if data[:-cut] == head() + pack(FRAMES[:whole]) else "ends within a record" in said[0]


def test_damage_in_the_middle_costs_one_record(tmp_path: Path) -> None:
    data = bytearray(head() + pack(FRAMES))
    at = len(head()) + len(pack(FRAMES[:9])) + 25
    data[at] ^= 0x40
    write(tmp_path, bytes(data))
    frames, report = read(tmp_path)
    assert frames == [*FRAMES[:9], *FRAMES[10:]]
    assert "is damaged" in report.sentences()[0]


@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=12))
def test_whatever_the_damage_only_true_records_come_out(damage: list[tuple[int, int]]) -> None:
    body = bytearray(pack(FRAMES))
    for at, value in damage:
        body[at % len(body)] = value
    from hal.replay.recording import _frames  # the reader of one segment's body

    report = LogReport()
    found = list(_frames("segment", bytes(body), 0, report))
    assert all(frame in FRAMES for frame in found)
    hit = len(FRAMES) - len(found)
    assert hit <= len(damage) + 1
    assert (hit == 0) == (not report.sentences())


def test_segments_that_do_not_belong_together(tmp_path: Path) -> None:
    write(
        tmp_path,
        head(0) + pack(FRAMES[:2]),
        b"LUMIREC\n broken",
        head(2) + pack(FRAMES[2:4]),
        head(3, "b") + pack(FRAMES),
    )
    frames, report = read(tmp_path)
    assert frames == FRAMES[:4]
    said = " ".join(report.sentences())
    assert "000001.lumirec: the head is damaged" in said
    assert "000002.lumirec: the previous segment is missing" in said
    assert "000003.lumirec: the segment belongs to another recording" in said


def test_several_recordings_in_one_folder_must_be_named(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    write(tmp_path / "one", head() + pack(FRAMES))
    assert read(tmp_path)[0] == FRAMES  # the only one is meant
    (tmp_path / "two").mkdir()
    write(tmp_path / "two", head(recording="b") + pack(FRAMES))
    with pytest.raises(DataInvalid, match="2 recordings: one, two"):
        open_recording(tmp_path)


def test_what_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(DataInvalid, match="holds no recording"):
        open_recording(tmp_path)
    with pytest.raises(DeviceMissing):
        open_recording(tmp_path / "missing")
    write(tmp_path, b"", b"something else entirely")
    with pytest.raises(DataInvalid, match="no segment has a readable head"):
        open_recording(tmp_path)


def test_a_newer_format_is_refused(tmp_path: Path) -> None:
    data = bytearray(head())
    data[8] = 3
    with pytest.raises(DataInvalid, match=r"version 3.*newer lumiloop"):
        open_recording(write(tmp_path, bytes(data)))


def test_a_length_beyond_all_records_is_damage(tmp_path: Path) -> None:
    frame = bytearray(pack_frame(Kind.RX, 0, 1.0, b"abc"))
    frame[4:8] = struct.pack("<I", LONGEST + 1)
    frames, report = read(write(tmp_path, head() + bytes(frame) + pack(FRAMES[:1])))
    assert frames == FRAMES[:1]
    assert report.sentences()


def test_readings_keep_every_bit() -> None:
    odometry = RawOdometry(1 / 3, 2 / 3, 0.1, -0.2, 1e-17)
    imu = RawImu(1 / 7, 2 / 7, -0.3)
    assert unpack_odometry(pack_odometry(odometry)) == odometry
    assert unpack_imu(pack_imu(imu)) == imu


def test_frames_are_streamed(tmp_path: Path) -> None:
    """A long recording must not have to fit into memory: the first record comes before the second segment is read."""
    write(tmp_path, head(0) + pack(FRAMES[:1]), head(1) + pack(FRAMES[1:2]))
    recording: Recording = open_recording(tmp_path)
    frames = recording.frames(LogReport())
    assert next(frames) == FRAMES[0]
    (tmp_path / segment_name(1)).unlink()
    with pytest.raises(DeviceMissing):
        next(frames)


def test_a_head_whose_sum_is_right_and_whose_text_is_not_json_is_damaged(tmp_path: Path) -> None:
    text = b'{"recording": "\x8b"}'
    start = struct.pack("<8sHI", b"LUMIREC\n", 2, len(text)) + text
    (tmp_path / segment_name(0)).write_bytes(start + struct.pack("<I", zlib.crc32(start)))
    with pytest.raises(DataInvalid):
        open_recording(tmp_path / segment_name(0))


def test_megabytes_of_what_looks_like_records_take_no_hours(tmp_path: Path) -> None:
    lie = MARKER + bytes(2) + (LONGEST - 1).to_bytes(4, "little")
    (tmp_path / segment_name(0)).write_bytes(head() + 400_000 * lie + pack(FRAMES[:3]))
    begin = time.thread_time()
    frames, _ = read(tmp_path / segment_name(0))
    assert frames == FRAMES[:3]
    assert time.thread_time() - begin < 40.0  # half a second on an idle machine; hours with every sum computed


def test_a_header_is_read_without_the_records_behind_it(tmp_path: Path) -> None:
    segment = tmp_path / "000000.lumilog"
    whole = pack_head({"recording": "a", "segment": 0})
    segment.write_bytes(whole + b"whatever follows")
    assert header_of(segment) == {"recording": "a", "segment": 0}
    too_long = whole[: whole.index(b"{") - 4] + b"\xff" * 4 + whole[whole.index(b"{") :]
    too_deep = b"[" * 100_000
    for damaged in (b"", whole[:3], whole[:-1], whole[:-1] + b"x", too_long, deep_head(too_deep)):
        segment.write_bytes(damaged)
        assert header_of(segment) is None
    assert header_of(tmp_path / "none") is None


def deep_head(text: bytes) -> bytes:
    """A head with a right sum over a text that is no header."""
    start = struct.pack(HEAD["head of a segment"], MAGIC, VERSION, len(text)) + text
    return start + struct.pack("<I", zlib.crc32(start))
