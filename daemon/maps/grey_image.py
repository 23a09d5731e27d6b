"""Greyscale image reader for imported maps: PGM (Netpbm) and PNG (ISO/IEC 15948)."""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps.png import SIGNATURE

Shades = npt.NDArray[np.float64]

_PGM: Final = re.compile(rb"P([25])((?:\s+|#[^\n]*\n)+)(\d+)((?:\s+|#[^\n]*\n)+)(\d+)((?:\s+|#[^\n]*\n)+)(\d+)")
_CHANNELS: Final = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Channels by PNG colour type."""
_DEPTHS: Final = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_PALETTE: Final = 3


class BadPicture(Exception):
    """An image that cannot be used; the text states the reason and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """Greyscale image (rows, columns), top row first, 0 black to 1 white: the mean of the colours.

    Attributes:
        grey: pixel values. alpha: 1 opaque, None where the image has no transparency. colours: 1 or 3.
    """

    grey: Shades
    alpha: Shades | None = None
    colours: int = 1


def read_picture(data: bytes, most: int) -> Picture:
    """Decode a PGM or PNG of at most ``most`` pixels.

    Raises:
        BadPicture: it is neither, or damaged, or too large.
    """
    if data.startswith(SIGNATURE):
        return _png(data, most)
    if data[:2] in (b"P2", b"P5"):
        return _pgm(data, most)
    raise BadPicture("is neither PGM nor PNG; convert it, for instance: convert map.bmp map.pgm")


def _size(columns: int, rows: int, most: int) -> None:
    if columns < 1 or rows < 1 or columns * rows > most:
        raise BadPicture(f"is said to be {columns} x {rows} pixels; 1 to {most} can be read")


def _pgm(data: bytes, most: int) -> Picture:
    head = _PGM.match(data)
    if head is None:
        raise BadPicture("its head is not that of a PGM: P5 or P2, columns, rows, largest value")
    columns, rows, largest = int(head[3]), int(head[5]), int(head[7])
    _size(columns, rows, most)
    if not 0 < largest < 65536:
        raise BadPicture(f"its largest value is said to be {largest}; 1 to 65535 can be")
    count = rows * columns
    if head[1] == b"2":
        try:
            values = np.array(re.sub(rb"#[^\n]*", b"", data[head.end() :]).split(), dtype=np.int64)
        except (ValueError, OverflowError):
            raise BadPicture("holds something else than whole numbers; export it again") from None
    else:
        values = np.frombuffer(data[head.end() + 1 :], np.uint8)
        if largest > 255:
            values = values[: len(values) // 2 * 2].view(">u2")
    if len(values) < count:
        raise BadPicture(f"ends after {len(values)} of its {count} pixels; copy it again")
    shades = values[:count].astype(np.float64).reshape(rows, columns) / largest
    if shades.min() < 0.0 or shades.max() > 1.0:
        raise BadPicture(f"has values beyond its largest one, {largest}; export it again")
    return Picture(shades)


def _png(data: bytes, most: int) -> Picture:
    chunks = _chunks(data)
    if "IHDR" not in chunks or len(chunks["IHDR"]) != 13 or "IDAT" not in chunks:
        raise BadPicture("is a PNG without a head or without pixels; copy it again")
    columns, rows, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", chunks["IHDR"])
    _size(columns, rows, most)
    if depth not in _DEPTHS.get(colour, ()):
        raise BadPicture(f"is a PNG of colour type {colour} with {depth} bits, which does not exist")
    if interlaced:
        raise BadPicture("is an interlaced PNG; save it without interlacing")
    channels = _CHANNELS[colour]
    wide = (columns * channels * depth + 7) // 8
    unpacker = zlib.decompressobj()
    try:
        packed = unpacker.decompress(chunks["IDAT"], rows * (wide + 1) + 1)
    except zlib.error as error:
        raise BadPicture(f"its pixels cannot be unpacked ({error}); copy it again") from None
    if len(packed) != rows * (wide + 1):
        raise BadPicture("has fewer or more pixels than it says; copy it again")
    lines = np.frombuffer(packed, np.uint8).reshape(rows, wide + 1)
    values = _values(_unfiltered(lines, max(1, channels * depth // 8)), depth, columns * channels)
    return _shaded(values.reshape(rows, columns, channels), depth, colour, chunks)


def _shaded(values: npt.NDArray[np.int64], depth: int, colour: int, chunks: dict[str, bytes]) -> Picture:
    full = float(2**depth - 1)
    if colour == _PALETTE:
        table = np.frombuffer(chunks.get("PLTE", b""), np.uint8)
        table = table[: len(table) // 3 * 3].reshape(-1, 3)
        if values.max() >= len(table):
            raise BadPicture("uses colours that its palette does not have; save it again")
        clear = np.full(len(table), 255.0)
        told = np.frombuffer(chunks.get("tRNS", b""), np.uint8)[: len(table)]
        clear[: len(told)] = told
        alpha = clear[values[..., 0]] / 255.0 if len(told) else None
        return Picture(table.mean(axis=1)[values[..., 0]] / 255.0, alpha, 3)
    colours = 3 if colour in (2, 6) else 1
    alpha = values[..., -1] / full if colour in (4, 6) else None
    return Picture(values[..., :colours].mean(axis=2) / full, alpha, colours)


def _chunks(data: bytes) -> dict[str, bytes]:
    """Chunk contents by type, those of one type concatenated."""
    found: dict[str, bytes] = {}
    at = len(SIGNATURE)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, content = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        crc = data[at + 8 + length : at + 12 + length]
        if len(crc) < 4 or zlib.crc32(kind + content) != int.from_bytes(crc, "big"):
            raise BadPicture("is damaged (checksum), or cut off; copy it again")
        name = kind.decode("latin-1")
        found[name] = found.get(name, b"") + content
        if name == "IEND":
            return found
        at += 12 + length
    raise BadPicture("is cut off; copy it again")


def _unfiltered(lines: npt.NDArray[np.uint8], step: int) -> npt.NDArray[np.uint8]:
    """Undo the filter of each line; ``step``: bytes of a pixel."""
    out = np.zeros((len(lines) + 1, lines.shape[1] - 1), np.uint8)
    for row, line in enumerate(lines, 1):
        kind, raw, above = int(line[0]), line[1:], out[row - 1]
        if kind == 0:
            out[row] = raw
        elif kind == 1:
            for first in range(step):
                out[row, first::step] = np.cumsum(raw[first::step], dtype=np.uint8)
        elif kind == 2:
            out[row] = raw + above
        elif kind in (3, 4):
            out[row] = _along(raw.tolist(), above.tolist(), step, kind)
        else:
            raise BadPicture(f"names a filter, {kind}, that does not exist; save it again")
    return out[1:]


def _along(raw: list[int], above: list[int], step: int, kind: int) -> list[int]:
    """Undo a filter that depends on the preceding pixels of the line: Average or Paeth."""
    line: list[int] = []
    for at, value in enumerate(raw):
        a = line[at - step] if at >= step else 0
        b, c = above[at], above[at - step] if at >= step else 0
        if kind == 3:
            guess = (a + b) // 2
        else:
            p, q, r = abs(b - c), abs(a - c), abs(a + b - 2 * c)
            guess = a if p <= q and p <= r else b if q <= r else c
        line.append((value + guess) & 255)
    return line


def _values(lines: npt.NDArray[np.uint8], depth: int, count: int) -> npt.NDArray[np.int64]:
    """Samples of each line as integers."""
    if depth == 16:
        return lines.view(">u2").astype(np.int64)
    if depth == 8:
        return lines.astype(np.int64)
    bits = np.unpackbits(lines, axis=1)
    size = bits.shape[1] // depth
    weights = 1 << np.arange(depth - 1, -1, -1)
    return np.asarray((bits.reshape(len(lines), size, depth) * weights).sum(axis=2)[:, :count], dtype=np.int64)
