"""Binary container of a map file: named compressed arrays with checksums. Pure: bytes in, bytes out.

Little-endian throughout: a head of 24 bytes, a table with one row of 48 bytes per array, and the arrays. An array is a
chain of blocks that are packed separately:

    head    magic (8 bytes), version (u16), arrays (u16), CRC-32 of the table, started with the version (u32),
            length of the file (u64)
    row     name (16 bytes), dtype (4), columns (u32, 0: one-dimensional), rows (u64), packed length (u64),
            CRC-32 (u32), packing (u8: 1 zlib of the bytes sorted by significance, 2 the same of differences), 3 zeros
    block   length as packed (u32), rows (u32), content

The magic follows PNG's: a transfer as text changes it visibly. A CRC-32 detects every burst error of up to 32 bits, and
misses one in 4e9 other errors.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

AnyArray = npt.NDArray[Any]
Content = AnyArray | Sequence[AnyArray]
"""An array, or consecutive pieces of it."""

MAGIC: Final = b"\x8bLUMI\r\n\x1a"
VERSION: Final = 1
HEAD: Final = struct.Struct("<8sHHIQ")
ROW: Final = struct.Struct("<16s4sIQQIB3x")
BLOCK: Final = struct.Struct("<II")
BLOCK_BYTES: Final = 1 << 18
"""Size of a block in bytes: packing it holds the interpreter lock for less than a millisecond."""
DTYPES: Final = ("|u1", "<i4", "<i8", "<f4", "<f8")
MOST_BYTES: Final = 1 << 31
"""Largest size of a map in bytes; a table with a larger size is damaged."""
SMALL_BYTES: Final = 64 << 20
MOST_RATIO: Final = 32
"""Largest compression ratio of more than `SMALL_BYTES` (measured: 2); zlib can reach 1000."""
SORTED, DIFFERENCES = 1, 2
LEVEL: Final = 1
"""zlib level: higher ones take five times as long for a twentieth less."""


class BadMap(Exception):
    """A map that cannot be used. The text states the defect, without the file's name.

    Attributes:
        remedy: what an operator can do, or what the daemon does. advice: the same for an operator who named the file.
    """

    remedy = "the file is kept, but not used"
    advice = "name another file, for example the previous generation"


class Foreign(BadMap):
    """The file is no map file at all."""


class Newer(BadMap):
    """A newer version of this software has written the file."""

    remedy = "install that version of lumiloop, or move the file away"
    advice = "read the file with that version of lumiloop"


class Damaged(BadMap):
    """The file's content is damaged."""


def nothing() -> None:
    """Default of ``breathe``: no pause between slices of work."""


def pack(arrays: Mapping[str, Content], breathe: Callable[[], None] = nothing) -> bytes:
    """Encode arrays as a file; ``breathe`` is called between slices of work so that other threads can run."""
    rows, contents = [], []
    for name, content in arrays.items():
        pieces = [content] if isinstance(content, np.ndarray) else list(content)
        first = pieces[0]
        dtype = first.dtype.newbyteorder("<").str
        packing = DIFFERENCES if dtype == "<i4" else SORTED
        length, crc, count = 0, 0, 0
        for block, n in _blocks(pieces, packing):
            contents.append(block)
            length, crc, count = length + len(block), zlib.crc32(block, crc), count + n
            breathe()
        columns = first.shape[1] if first.ndim == 2 else 0
        rows.append(ROW.pack(name.encode("ascii"), dtype.encode(), columns, count, length, crc, packing))
    table = b"".join(rows)
    total = HEAD.size + len(table) + sum(map(len, contents))
    return b"".join((HEAD.pack(MAGIC, VERSION, len(rows), _checksum(VERSION, table), total), table, *contents))


def _checksum(version: int, table: bytes) -> int:
    return zlib.crc32(table, version)


def unpack(data: bytes, known: Container[str] | None = None) -> dict[str, AnyArray]:
    """Decode the arrays of a file, each in its own memory; ``known``: permitted names, None: any.

    Raises:
        Foreign: not a map file. Newer: of a later version. Damaged: anything else; names the position.
    """
    version, count, crc = _head(data)
    table = data[HEAD.size : HEAD.size + count * ROW.size]
    if len(table) != count * ROW.size or _checksum(version, table) != crc:
        raise Damaged("its table of contents is damaged (checksum)")
    _bounded(table, len(data), known)
    at, arrays = HEAD.size + len(table), {}
    for name, dtype, columns, rows, length, crc, packing in ROW.iter_unpack(table):
        title = name.rstrip(b"\0").decode("ascii", "replace")
        packed = memoryview(data)[at : at + length]
        at += length
        if len(packed) != length or zlib.crc32(packed) != crc:
            raise Damaged(f"part `{title}`, bytes {at - length} to {at}, is damaged (checksum)")
        arrays[title] = _array(title, packed, dtype.decode("ascii", "replace").rstrip("\0"), (columns, rows, packing))
    if at != len(data):
        raise Damaged(f"{len(data) - at} bytes follow its last part")
    return arrays


def _bounded(table: bytes, packed: int, known: Container[str] | None) -> None:
    """Check the sizes in the table before anything is unpacked."""
    size = 0
    for name, dtype, columns, rows, *_ in ROW.iter_unpack(table):
        title, kind = name.rstrip(b"\0").decode("ascii", "replace"), dtype.decode("ascii", "replace").rstrip("\0")
        if known is not None and title not in known:
            raise Damaged(f"the part {title!r} is not a part of version {VERSION}")
        size += rows * max(1, columns) * (np.dtype(kind).itemsize if kind in DTYPES else 1)
    if size > min(MOST_BYTES, max(SMALL_BYTES, MOST_RATIO * packed)):
        raise Damaged(f"its {packed} bytes claim to unpack to {size} bytes, which is impossible")


def _head(data: bytes) -> tuple[int, int, int]:
    """Version, number of arrays, and the table's checksum."""
    if len(data) < HEAD.size:
        if not MAGIC.startswith(data[: len(MAGIC)]):
            raise Foreign("it is not a map file of lumiloop")
        raise Damaged(f"the file ends in its head, after {len(data)} bytes")
    magic, version, count, crc, total = HEAD.unpack_from(data)
    if magic != MAGIC:
        raise Foreign("it is not a map file of lumiloop")
    if version > VERSION:
        raise Newer(f"the file has version {version}; this software reads versions up to {VERSION}")
    if version < 1:
        raise Damaged(f"version {version} does not exist")
    if len(data) != total:
        raise Damaged(f"it is {len(data)} bytes long instead of {total}: truncated or extended")
    return version, count, crc


def _blocks(pieces: Sequence[AnyArray], packing: int) -> Iterator[tuple[bytes, int]]:
    """The blocks of an array that comes in pieces, with the number of rows in each."""
    held: list[AnyArray] = []
    size = 0
    for piece in pieces:
        step = max(1, BLOCK_BYTES // max(1, piece.itemsize * (piece.shape[1] if piece.ndim == 2 else 1)))
        for begin in range(0, len(piece), step):
            part = piece[begin : begin + step]
            if held and size + part.nbytes > BLOCK_BYTES:
                yield _block(held, packing)
                held, size = [], 0
            held.append(part)
            size += part.nbytes
    if held:
        yield _block(held, packing)


def _block(parts: Sequence[AnyArray], packing: int) -> tuple[bytes, int]:
    array = np.concatenate(parts)
    flat = array.astype(array.dtype.newbyteorder("<"), copy=False).reshape(-1)
    if packing == DIFFERENCES:
        flat = np.diff(flat, prepend=flat.dtype.type(0))
    by_place = np.ascontiguousarray(flat.view(np.uint8).reshape(-1, flat.itemsize).T)
    packed = zlib.compress(by_place.tobytes(), LEVEL)
    return BLOCK.pack(len(packed), len(array)) + packed, len(array)


def _array(title: str, packed: memoryview, dtype: str, row: tuple[int, int, int]) -> AnyArray:
    """Decode one array from its blocks; every value of the table is checked before it is used."""
    columns, rows, packing = row
    if dtype not in DTYPES or packing not in (SORTED, DIFFERENCES):
        raise Damaged(f"the part `{title}` has an unknown kind ({dtype}, packing {packing})")
    kind = np.dtype(dtype)
    width = max(1, columns)
    if rows * width * kind.itemsize > MOST_BYTES:
        raise Damaged(f"the part `{title}` claims to have {rows} rows")
    array = np.empty(rows * width, kind)
    at = done = 0
    while at < len(packed):
        if at + BLOCK.size > len(packed):
            raise Damaged(f"the part `{title}` ends within a block")
        length, count = BLOCK.unpack_from(packed, at)
        at += BLOCK.size
        if done + count > rows or count == 0:
            raise Damaged(f"the part `{title}` has more rows than its head states")
        content = _unpacked(title, packed[at : at + length], count * width * kind.itemsize)
        by_place = np.frombuffer(content, np.uint8).reshape(kind.itemsize, -1)
        flat = np.ascontiguousarray(by_place.T).reshape(-1).view(kind)
        if packing == DIFFERENCES:
            flat = np.cumsum(flat, dtype=kind)
        array[done * width : (done + count) * width] = flat
        at, done = at + length, done + count
    if done != rows:
        raise Damaged(f"the part `{title}` has {done} rows instead of {rows}")
    return array.reshape(rows, columns) if columns else array


def _unpacked(title: str, content: memoryview, size: int) -> bytes:
    try:
        found = zlib.decompressobj().decompress(content, size + 1)
    except zlib.error as error:
        raise Damaged(f"the part `{title}` cannot be unpacked ({error})") from None
    if len(found) != size:
        raise Damaged(f"a block of the part `{title}` unpacks to {len(found)} bytes instead of {size}")
    return found
