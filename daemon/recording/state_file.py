"""Checkpoint file format (``.lumistate``): stores the state beside the segment from which a replay can start.

``NNNNNN.lumistate``, little-endian: ``LUMISTAT``, format version (u16), length of the header (u32), the header (JSON),
CRC-32 of all that (u32). Then follow blocks, each with the length of its content (u32), CRC-32 of that (u32), and the
deflated content: a msgpack array of pieces ``[number, kind, content]``. `daemon.recording.checkpoint` defines the
pieces; the root is the last one. The first piece has the number -2. It contains the bytes of the lidar line that the
codec needs, as records.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from daemon.recording.restore import ROOT, Piece
from daemon.system.atomic_file import sync_folder

MAGIC: Final = b"LUMISTAT"
VERSION: Final = 2
LINE: Final = -2
BLOCK_BYTES: Final = 256 << 10
LONGEST: Final = 1 << 30
_START: Final = struct.Struct("<8sHI")
_BLOCK: Final = struct.Struct("<II")
_CRC: Final = struct.Struct("<I")

_encode: Final = msgspec.msgpack.Encoder().encode
_decode: Final = msgspec.msgpack.Decoder(list[tuple[int, str, bytes]]).decode


class BadState(Exception):
    """A state file that cannot be used; the text says what is wrong with it, ``remedy`` what to do."""

    remedy = "take the segments from the next state on"


class OtherVersion(BadState):
    """A state file of another format version."""

    remedy = "replay it with the version of lumiloop that recorded it"


def write_state(
    path: Path,
    header: dict[str, Any],
    line: bytes,
    pieces: Iterable[Piece],
    breathe: Callable[[], object] = lambda: None,
) -> int:
    """Writes a checkpoint file, whole or not at all, and returns its size in bytes.

    ``breathe`` is called after every :data:`SLICE` pieces.

    Raises:
        OSError: it cannot be written. CannotTake: a piece cannot be pickled.
    """
    beside = path.with_name(f".{path.name}.part")
    try:
        with beside.open("wb") as file:
            file.write(_head(header))
            for block in _blocks([Piece(LINE, "", line)], pieces, breathe):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
            size = file.tell()
        beside.replace(path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        raise
    return size


def _head(header: dict[str, Any]) -> bytes:
    text = json.dumps(header, sort_keys=True).encode()
    start = _START.pack(MAGIC, VERSION, len(text)) + text
    return start + _CRC.pack(zlib.crc32(start))


def _blocks(ready: list[Piece], pieces: Iterable[Piece], breathe: Callable[[], object]) -> Iterator[bytes]:
    waiting, size = list(ready), 0
    for piece in pieces:
        waiting.append(piece)
        size += len(piece.content)
        if len(waiting) % SLICE == 0:
            breathe()
        if size >= BLOCK_BYTES:
            yield _packed(waiting)
            waiting, size = [], 0
    yield _packed(waiting)


SLICE: Final = 16
"""Pieces pickled in one slice: some 0.2 ms."""


def _packed(pieces: list[Piece]) -> bytes:
    content = zlib.compress(_encode(pieces), 1)
    return _BLOCK.pack(len(content), zlib.crc32(content)) + content


def read_state(path: Path) -> tuple[dict[str, Any], bytes, Iterator[Piece]]:
    """Returns the header, the bytes of the lidar line, and the pieces.

    Raises:
        OSError: it cannot be read. BadState: it is damaged. OtherVersion: of another version.
    """
    data = path.read_bytes()
    header, at = _header(path, data)
    pieces = _pieces(path, data, at)
    first = next(pieces)
    if first.number != LINE:
        raise BadState(f"{path.name}: damaged")
    return header, first.content, pieces


def read_header(path: Path) -> dict[str, Any]:
    """Returns the header alone; raises as :func:`read_state` does."""
    with path.open("rb") as file:
        return _header(path, file.read(1 << 20))[0]


def _header(path: Path, data: bytes) -> tuple[dict[str, Any], int]:
    if len(data) < _START.size or not data.startswith(MAGIC):
        raise BadState(f"{path.name}: not a state file")
    _, version, length = _START.unpack_from(data)
    end = _START.size + length
    if version != VERSION:
        raise OtherVersion(f"{path.name}: format version {version}; this program reads version {VERSION}")
    if len(data) < end + _CRC.size or _CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
        raise BadState(f"{path.name}: damaged head")
    header: dict[str, Any] = json.loads(data[_START.size : end])
    return header, end + _CRC.size


def _pieces(path: Path, data: bytes, at: int) -> Iterator[Piece]:
    piece = Piece(LINE, "", b"")
    while at < len(data):
        if len(data) < at + _BLOCK.size:
            raise BadState(f"{path.name}: torn")
        length, crc = _BLOCK.unpack_from(data, at)
        at += _BLOCK.size
        content = data[at : at + length]
        if len(content) < length or zlib.crc32(content) != crc:
            raise BadState(f"{path.name}: damaged")
        for piece in map(Piece._make, _unpacked(path, content)):
            yield piece
        at += length
    if piece.number != ROOT:
        raise BadState(f"{path.name}: torn")


def _unpacked(path: Path, content: bytes) -> list[tuple[int, str, bytes]]:
    try:
        inflater = zlib.decompressobj()
        plain = inflater.decompress(content, LONGEST)
        return _decode(plain)
    except (zlib.error, msgspec.DecodeError) as error:
        raise BadState(f"{path.name}: damaged: {error}") from error
