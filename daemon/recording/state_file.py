"""Checkpoint file format (``.lumistate``): stores the state beside the segment from which a replay can start.

``NNNNNN.lumistate``, little-endian: ``LUMISTAT``, format version (u16), length of the header (u32), the header (JSON),
CRC-32 of all that (u32). Then follow blocks, each with the length of its content (u32), CRC-32 of that (u32), and the
deflated content. The first block contains the bytes of the lidar line that the codec needs, as records. Each of the
others contains a msgpack array of nodes as `daemon.recording.state_schema` defines them, by number. The last entry is
an `End`. The inflated blocks have at most :data:`MOST_BYTES` in all, each :data:`MOST_BLOCK`, and the nodes
:data:`MOST_VALUES`: a value of one byte takes 50 in memory. Nodes are therefore decoded one by one, and only those of a
possible length.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from daemon.recording.state_schema import VERSION, Array, Blob, End, Node, count_of
from daemon.system.atomic_file import sync_folder
from daemon.system.regular_file import read_regular, read_start

MAGIC: Final = b"LUMISTAT"
BLOCK_BYTES: Final = 256 << 10
MOST_BYTES: Final = 1 << 29
"""Limit of the inflated content, bytes; a ring of the flight recorder is not larger either."""
MOST_BLOCK: Final = 1 << 26
"""Limit of one inflated block, bytes: :data:`BLOCK_BYTES` and the largest node."""
MOST_VALUES: Final = 8_000_000
"""Limit of the values within nodes; the state of a map of 10000 submaps has 2.4 million."""
_START: Final = struct.Struct("<8sHI")
_BLOCK: Final = struct.Struct("<II")
_CRC: Final = struct.Struct("<I")

MOST_ENTRIES: Final = 1 << 18
"""Limit of the nodes in one block; one of usual size has 4096."""
_DATA: Final = (b"\xa5array", b"\xa5bytes")
"""Tags of nodes that can be longer than :data:`MOST_VALUES` bytes: they consist of data."""

_encode: Final = msgspec.msgpack.Encoder().encode
_split: Final = msgspec.msgpack.Decoder(Annotated[list[msgspec.Raw], msgspec.Meta(max_length=MOST_ENTRIES)]).decode
_decode: Final = msgspec.msgpack.Decoder(Node | End).decode


class BadState(Exception):
    """A state file that cannot be used; the text says what is wrong with it, ``remedy`` what to do."""

    remedy = "use the segments from the next checkpoint on"


class OtherVersion(BadState):
    """A state file of another format version."""

    remedy = "replay it with the version of lumiloop that recorded it"


def write_state(
    path: Path,
    header: dict[str, Any],
    line: bytes,
    nodes: Iterable[Node],
    breathe: Callable[[], object] = lambda: None,
) -> int:
    """Writes a checkpoint file, whole or not at all, and returns its size in bytes.

    ``breathe`` is called after every :data:`SLICE` nodes.

    Raises:
        OSError: it cannot be written. CannotTake: part of the state cannot be stored.
    """
    beside = path.with_name(f".{path.name}.part")
    try:
        with beside.open("wb") as file:
            file.write(_head(header))
            for block in _blocks(line, nodes, breathe):
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


def _blocks(line: bytes, nodes: Iterable[Node], breathe: Callable[[], object]) -> Iterator[bytes]:
    yield _packed(line)
    waiting: list[Node | End] = []
    size = count = 0
    for node in nodes:
        waiting.append(node)
        count += 1
        size += len(node.data) if isinstance(node, Array | Blob) else NODE_BYTES
        if count % SLICE == 0:
            breathe()
        if size >= BLOCK_BYTES:
            yield _packed(_encode(waiting))
            waiting, size = [], 0
    yield _packed(_encode([*waiting, End(count)]))


SLICE: Final = 32
"""Nodes made in one slice: some 0.2 ms."""
NODE_BYTES: Final = 64
"""Usual size of a node that is no array."""


def _packed(plain: bytes) -> bytes:
    content = zlib.compress(plain, 1)
    return _BLOCK.pack(len(content), zlib.crc32(content)) + content


def read_state(path: Path) -> tuple[dict[str, Any], bytes, Iterator[Node]]:
    """Returns the header, the bytes of the lidar line, and the nodes.

    Raises:
        OSError: it cannot be read. BadState: it is damaged. OtherVersion: of another version.
    """
    data = read_regular(path, MOST_BYTES)
    header, at = _header(path, data)
    plain = _plain(path, data, at)
    line = next(plain, None)
    if line is None:
        raise BadState(f"{path.name}: torn")
    return header, line, _nodes(path, plain)


def read_header(path: Path) -> dict[str, Any]:
    """Returns the header alone; raises as :func:`read_state` does."""
    return _header(path, read_start(path, 1 << 20))[0]


def _header(path: Path, data: bytes) -> tuple[dict[str, Any], int]:
    if len(data) < _START.size or not data.startswith(MAGIC):
        raise BadState(f"{path.name}: not a state file")
    _, version, length = _START.unpack_from(data)
    end = _START.size + length
    if version != VERSION:
        raise OtherVersion(f"{path.name}: format version {version}; this program reads version {VERSION}")
    if len(data) < end + _CRC.size or _CRC.unpack_from(data, end)[0] != zlib.crc32(data[:end]):
        raise BadState(f"{path.name}: damaged head")
    try:
        header: dict[str, Any] = msgspec.json.decode(data[_START.size : end], type=dict[str, Any])
    except (msgspec.DecodeError, RecursionError) as error:
        raise BadState(f"{path.name}: damaged head: {error}") from error
    return header, end + _CRC.size


def _plain(path: Path, data: bytes, at: int) -> Iterator[bytes]:
    """Yields the inflated content of each block."""
    left = MOST_BYTES
    while at < len(data):
        if len(data) < at + _BLOCK.size:
            raise BadState(f"{path.name}: torn")
        length, crc = _BLOCK.unpack_from(data, at)
        at += _BLOCK.size
        content = data[at : at + length]
        if len(content) < length or zlib.crc32(content) != crc:
            raise BadState(f"{path.name}: damaged")
        plain = _inflated(path, content, min(left, MOST_BLOCK))
        left -= len(plain)
        yield plain
        at += length


def _inflated(path: Path, content: bytes, most: int) -> bytes:
    """Returns the inflated content; stops where it has more than ``most`` bytes."""
    try:
        plain = zlib.decompressobj().decompress(content, most + 1)
    except zlib.error as error:
        raise BadState(f"{path.name}: damaged: {error}") from error
    if len(plain) > most:
        raise BadState(f"{path.name}: larger when inflated than any state")
    return plain


def _nodes(path: Path, plain: Iterator[bytes]) -> Iterator[Node]:
    count, left, ended = 0, MOST_VALUES, False
    for entry in _entries(path, plain):
        if ended or (isinstance(entry, End) and entry.nodes != count):
            raise BadState(f"{path.name}: damaged")
        if isinstance(entry, End):
            ended = True
            continue
        count += 1
        left -= count_of(entry)
        if left < 0:
            raise BadState(f"{path.name}: more than {MOST_VALUES} values")
        yield entry
    if not ended:
        raise BadState(f"{path.name}: torn")


def _entries(path: Path, plain: Iterator[bytes]) -> Iterator[Node | End]:
    """Yields the entries of the blocks; refuses those whose values could not all be held."""
    for content in plain:
        try:
            for raw in _split(content):
                packed = memoryview(raw)
                if len(packed) > MOST_VALUES and bytes(packed[1:7]) not in _DATA:
                    raise BadState(f"{path.name}: more than {MOST_VALUES} values")
                yield _decode(packed)
        except (msgspec.DecodeError, RecursionError) as error:
            raise BadState(f"{path.name}: damaged: {error}") from error
