"""Reads raw captures of a serial line: the bytes of a SCIP sensor (``.logr``) and of its host (``.logw``).

Each record is an 8-byte big-endian time in microseconds, a 4-byte big-endian length, and the bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hal.errors import DataInvalid
from hal.replay.monotone_stamps import monotone
from hal.replay.report import LogReport
from hal.replay.text import unreadable

_HEAD: Final = struct.Struct(">QI")
_LONGEST: Final = 1 << 20
_FEW: Final = 5
"""Chunks that may have come in one instant."""
_LATEST_US: Final = 1 << 53  # 285 years: a later time is text, not a time


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes received at ``t_us``, microseconds of the capturing host's clock."""

    t_us: int
    data: bytes


def looks_like_capture(head: bytes) -> bool:
    """Whether a file that begins with ``head`` (at least 12 bytes) can be a capture."""
    if len(head) < _HEAD.size:
        return False
    t_us: int
    length: int
    t_us, length = _HEAD.unpack_from(head)
    return t_us < _LATEST_US and 0 < length <= _LONGEST


def read_capture(path: Path, report: LogReport) -> list[Chunk]:
    """All chunks of a capture; a truncated end loses only the last chunk and is noted in ``report``.

    Raises:
        DeviceMissing, DeviceRefused: no such file, or no permission to read it.
        DataInvalid: empty, not a capture, or without usable time.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error
    if not looks_like_capture(data):
        problem = "the file is empty" if not data else "not a capture of a serial line"
        raise DataInvalid(str(path), problem, "name a .logr file, or another kind of log")
    chunks = list(_chunks(data, report))
    if not chunks:
        raise DataInvalid(str(path), "ends within its first record", "name another log; this one has no data")
    chunks = _in_time(path, chunks, report)
    report.use("chunks", len(chunks))
    report.use("bytes", sum(len(chunk.data) for chunk in chunks))
    return chunks


def _in_time(path: Path, chunks: list[Chunk], report: LogReport) -> list[Chunk]:
    """The chunks with times that increase, where the host's clock was set or is coarse.

    Raises:
        DataInvalid: all times are equal.
    """
    stamps = 1e-6 * np.array([chunk.t_us for chunk in chunks])
    clock = monotone(stamps, 0.0)
    if len(chunks) > _FEW and clock.duplicates == len(chunks) - 1:
        raise DataInvalid(str(path), f"all {len(chunks)} times in it are equal", "capture the line with its times")
    if not (clock.backward or clock.restarts or clock.wild or clock.coarse_s):
        return chunks
    report.notes.append("the host's clock was set or is coarse; its steps are removed or spread")
    return [Chunk(round(1e6 * t), chunk.data) for t, chunk in zip(clock.time.tolist(), chunks, strict=True)]


def _chunks(data: bytes, report: LogReport) -> Iterator[Chunk]:
    at = 0
    while at < len(data):
        if not looks_like_capture(data[at : at + _HEAD.size]):
            report.skip(at, "the capture ends with bytes that are not a record; they are skipped")
            return
        t_us, length = _HEAD.unpack_from(data, at)
        chunk = data[at + _HEAD.size : at + _HEAD.size + length]
        if len(chunk) < length:
            report.skip(at, "the capture ends within a record")
            return
        yield Chunk(t_us, chunk)
        at += _HEAD.size + length
