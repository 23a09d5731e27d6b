r"""The lumiloop recording: a folder of append-only segments, readable after a power cut up to the last whole record.

Segment file ``NNNNNN.lumirec``, all numbers little-endian:

* head: ``LUMIREC\n``, format version (u16), length of the header (u32), the header (JSON), CRC-32 of all that (u32);
* records: marker 0xA5 0x5A, kind (u8), channel (u8), payload length (u32), ``t_mono`` (f64), CRC-32 (u32) of
  kind to ``t_mono`` and payload, payload.

Every segment repeats the header, so that each can be read alone. Written bytes are never changed. After a truncated or
damaged record the reader finds the next one by its marker and verifies it by its CRC.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

import numpy as np

from hal.adc import Blemish, RawSamples
from hal.errors import DataInvalid
from hal.imu import RawImu
from hal.lidar import RawScan
from hal.odometry import RawOdometry
from hal.replay.report import LogReport
from hal.replay.text import unreadable

MAGIC: Final = b"LUMIREC\n"
VERSION: Final = 2
"""Version 2 adds SAMPLES, and lights in the header; version 1 is read, too."""
SUFFIX: Final = ".lumirec"
STATE_SUFFIX: Final = ".lumistate"
MARKER: Final = b"\xa5\x5a"
LONGEST: Final = 1 << 20
"""Longest payload; a larger length is damage."""

_SHORT: Final = 4096
_START: Final = struct.Struct("<8sHI")
_HEAD: Final = struct.Struct("<2sBBIdI")
_SUMMED: Final = struct.Struct("<BBId")
_CRC: Final = struct.Struct("<I")
_ODOMETRY: Final = struct.Struct("<5d")
_IMU: Final = struct.Struct("<3d")
_SCAN: Final = struct.Struct("<q3d")
_SAMPLES: Final = struct.Struct("<q5dBxHI")


class Kind(IntEnum):
    """Kind of a record. The numbers are part of the format: never renumber."""

    RX = 1  # bytes from a device, as they arrived
    TX = 2  # bytes to a device
    OPEN = 3  # a port was opened; payload: its name and rate as text
    LOST = 4  # a port was lost; payload: why
    BAUD = 5  # the line rate was changed; payload: the new rate as text
    SCAN = 8  # a scan of the driver: number and times; its ranges are in RX
    SAMPLES = 9  # a sample block of the photodiode's driver
    ODOMETRY = 16
    IMU = 17
    COMMAND = 18
    CYCLE = 32
    NOTE = 48  # text for people: gaps of the recording itself


HEAD: Final = {"head of a segment": _START.format, "head of a record": _HEAD.format}
LAYOUTS: Final = {
    Kind.SCAN: (_SCAN.format, "seq t_rx t_mono t_sigma"),
    Kind.SAMPLES: (_SAMPLES.format + " and words <H", "seq t0 t1 t_first rate_hz slack_s bits blemish count"),
    Kind.ODOMETRY: (_ODOMETRY.format, "t_rx t_mono x y yaw"),
    Kind.IMU: (_IMU.format, "t_rx t_mono yaw_rate"),
}
"""Layouts (as of the `struct` module) and fields of the payloads that are binary. Part of the format."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One record; ``channel`` distinguishes devices of one kind (0: the lidar)."""

    kind: int
    channel: int
    t_mono: float
    payload: bytes


def pack_head(header: dict[str, Any]) -> bytes:
    """The head of a segment."""
    text = json.dumps(header, sort_keys=True).encode()
    start = _START.pack(MAGIC, VERSION, len(text)) + text
    return start + _CRC.pack(zlib.crc32(start))


def pack_frame(kind: int, channel: int, t_mono: float, payload: bytes) -> bytes:
    """One record."""
    crc = zlib.crc32(payload, zlib.crc32(_SUMMED.pack(kind, channel, len(payload), t_mono)))
    return _HEAD.pack(MARKER, kind, channel, len(payload), t_mono, crc) + payload


@dataclass(frozen=True, slots=True)
class ScanMark:
    """Number and times of a delivered scan; its ranges are in the RX bytes. Fields as in `hal.lidar.RawScan`."""

    seq: int
    t_rx: float
    t_mono: float
    t_sigma: float


def pack_scan(scan: RawScan) -> bytes:
    """Payload of a SCAN record."""
    return _SCAN.pack(scan.seq, scan.t_rx, scan.t_mono, scan.t_sigma)


def unpack_scan(payload: bytes) -> ScanMark:
    """The mark in a SCAN record; raises `struct.error` for a payload of another length."""
    return ScanMark(*_SCAN.unpack(payload))


def pack_samples(block: RawSamples) -> bytes:
    """Payload of a SAMPLES record."""
    times = (block.t0, block.t1, block.t_first, block.rate_hz, block.slack_s)
    head = _SAMPLES.pack(block.seq, *times, block.bits, block.blemish.value, block.words.size)
    return head + block.words.astype("<u2").tobytes()


def unpack_samples(payload: bytes) -> RawSamples:
    """The block in a SAMPLES record; raises `struct.error` or `ValueError` for a payload that is not one."""
    seq, t0, t1, t_first, rate_hz, slack_s, bits, blemish, count = _SAMPLES.unpack_from(payload)
    words = np.frombuffer(payload, dtype="<u2", offset=_SAMPLES.size).astype(np.uint16)
    if words.size != count:
        raise ValueError(f"{words.size} of {count} samples")
    return RawSamples(seq, t0, t1, t_first, rate_hz, words, bits, Blemish(blemish), slack_s)


def pack_odometry(reading: RawOdometry) -> bytes:
    """Payload of an ODOMETRY record."""
    return _ODOMETRY.pack(reading.t_rx, reading.t_mono, reading.x, reading.y, reading.yaw)


def unpack_odometry(payload: bytes) -> RawOdometry:
    """The reading in an ODOMETRY record; raises `struct.error` for a payload of another length."""
    return RawOdometry(*_ODOMETRY.unpack(payload))


def pack_imu(reading: RawImu) -> bytes:
    """Payload of an IMU record."""
    return _IMU.pack(reading.t_rx, reading.t_mono, reading.yaw_rate)


def unpack_imu(payload: bytes) -> RawImu:
    """The reading in an IMU record; raises `struct.error` for a payload of another length."""
    return RawImu(*_IMU.unpack(payload))


def segment_name(number: int) -> str:
    """File name of the ``number``-th segment, counted from 0."""
    return f"{number:06d}{SUFFIX}"


def state_name(number: int) -> str:
    """File name of the estimator state at the start of the ``number``-th segment, if one was saved."""
    return f"{number:06d}{STATE_SUFFIX}"


def segments_of(folder: Path) -> list[Path]:
    """Segments of a recording in order.

    A single segment file is a recording, too; a folder with exactly one recording's folder stands for it.

    Raises:
        DeviceMissing, DeviceRefused: no such path, or no permission to read it.
        DataInvalid: the folder holds several recordings.
    """
    try:
        if not folder.is_dir():
            return [folder] if folder.stat() else []
        inside = sorted(folder.iterdir())
        runs = [path for path in inside if path.is_dir() and any(file.suffix == SUFFIX for file in path.iterdir())]
        found = [path for path in inside if path.suffix == SUFFIX]
        return segments_of(runs[0]) if len(runs) == 1 and not found else found or _choose(folder, runs)
    except OSError as error:
        raise unreadable(folder, error) from error


def _choose(folder: Path, runs: list[Path]) -> list[Path]:
    if len(runs) > 1:
        names = ", ".join(path.name for path in runs)
        raise DataInvalid(str(folder), f"holds {len(runs)} recordings: {names}", "name one of them")
    return []


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording on disk: its header, and its records as a stream."""

    path: Path
    header: dict[str, Any]
    segments: tuple[Path, ...]
    first: int = 0
    """Number of its first segment."""

    def frames(self, report: LogReport) -> Iterator[Frame]:
        """Every whole record in order; truncated and damaged ones are counted in ``report`` with their place.

        Raises:
            DeviceRefused: a segment cannot be read.
        """
        number = self.first - 1
        for path in self.segments:
            data = _load(path)
            header, at = _read_head(data)
            if header is None:
                report.notes.append(f"{path.name}: the head is damaged, and the segment is skipped ({len(data)} bytes)")
                continue
            if header.get("recording") != self.header.get("recording"):
                report.notes.append(f"{path.name}: the segment belongs to another recording and is skipped")
                continue
            if header.get("segment") != number + 1:
                report.notes.append(f"{path.name}: the previous segment is missing")
            number = int(header.get("segment", number))
            yield from _frames(path.name, data, at, report)


def frames_in(data: bytes) -> Iterator[Frame]:
    """The whole records in ``data``."""
    return _frames("", data, 0, LogReport())


def open_recording(path: Path) -> Recording:
    """Find the segments of a recording and read its header.

    Raises:
        DeviceMissing, DeviceRefused: no such path, or no permission to read it.
        DataInvalid: no segment has a readable head, or a newer version wrote it.
    """
    segments = segments_of(path)
    if not segments:
        raise DataInvalid(str(path), f"holds no recording (no *{SUFFIX})", "name the folder given to `run --record`")
    for segment in segments:
        data = _load(segment)
        _check_version(segment, data)
        header, _ = _read_head(data)
        if header is not None:
            return Recording(path, header, tuple(segments))
    raise DataInvalid(str(segments[0]), "not a recording: no segment has a readable head", "check the path")


def header_of(segment: Path) -> dict[str, Any] | None:
    """A segment's header, without reading the records; None where unreadable or damaged."""
    try:
        with segment.open("rb") as file:
            start = file.read(_START.size)
            whole = len(start) == _START.size and start.startswith(MAGIC)
            length = (
                min(_START.unpack(start)[2], segment.stat().st_size) if whole else 0
            )  # a damaged length may exceed the file
            rest = file.read(length + _CRC.size)
    except OSError:
        return None
    return _read_head(start + rest)[0]


def looks_like_recording(head: bytes) -> bool:
    """Whether a file beginning with ``head`` is a segment."""
    return head.startswith(MAGIC)


def _load(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error


def _check_version(path: Path, data: bytes) -> None:
    if len(data) >= _START.size and data.startswith(MAGIC):
        version = _START.unpack_from(data)[1]
        if version > VERSION:
            raise DataInvalid(
                str(path), f"format version {version}; this program reads up to {VERSION}", "use a newer lumiloop"
            )


def _read_head(data: bytes) -> tuple[dict[str, Any] | None, int]:
    """The header and the offset of the first record; None where the head is damaged."""
    if len(data) < _START.size or not data.startswith(MAGIC):
        return None, 0
    end = _START.size + _START.unpack_from(data)[2]
    if len(data) < end + _CRC.size or _CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
        return None, 0
    try:
        header = json.loads(data[_START.size : end])
    except (ValueError, RecursionError):  # a valid CRC over something else than JSON
        return None, 0
    return (header, end + _CRC.size) if isinstance(header, dict) else (None, 0)


def _frames(name: str, data: bytes, at: int, report: LogReport) -> Iterator[Frame]:
    while at < len(data):
        frame, end = _frame_at(data, at)
        if frame is not None:
            report.use(_kind_name(frame.kind))
            yield frame
        else:
            end = _next_frame(data, at + 1)
            where = "ends within a record" if end == len(data) else "is damaged"
            report.skip(at, f"{name} {where}: {end - at} bytes lost")
        at = end


def _frame_at(data: bytes, at: int) -> tuple[Frame | None, int]:
    if len(data) < at + _HEAD.size:
        return None, len(data)
    marker, kind, channel, length, t_mono, crc = _HEAD.unpack_from(data, at)
    begin = at + _HEAD.size
    end = begin + length
    if marker != MARKER or length > LONGEST or end > len(data):
        return None, len(data)
    if zlib.crc32(data[begin:end], zlib.crc32(_SUMMED.pack(kind, channel, length, t_mono))) != crc:
        return None, len(data)
    return Frame(kind, channel, t_mono, data[begin:end]), end


def _next_frame(data: bytes, at: int) -> int:
    """Offset of the next whole record, or the end of the data.

    A long candidate is verified only if a marker or the end of the data follows it: megabytes of accidental markers
    would otherwise take hours of CRC computation.
    """
    while (at := data.find(MARKER, at)) >= 0:
        if len(data) >= at + _HEAD.size:
            length = _HEAD.unpack_from(data, at)[3]
            end = at + _HEAD.size + length
            likely = length <= _SHORT or end == len(data) or data.startswith(MARKER, end)
            if likely and _frame_at(data, at)[0] is not None:
                return at
        at += 1
    return len(data)


def _kind_name(kind: int) -> str:
    return Kind(kind).name.lower() if kind in Kind._value2member_map_ else f"kind {kind}"
