"""PNG decoder for where Pillow is not installed (ISO/IEC 15948): greyscale, colour and palettes, not interlaced."""

from __future__ import annotations

import struct
import zlib
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps.map_server.pixels import BadPicture, Picture, check_size
from daemon.maps.png import SIGNATURE
from daemon.system.extras import how_to_install

MOST: Final = 1 << 22
"""Largest image, in pixels: some PNG filters take a microsecond a pixel here."""
_CHANNELS: Final = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Channels by PNG colour type."""
_DEPTHS: Final = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_PALETTE: Final = 3


def read_png(data: bytes) -> Picture:
    """Decode a PNG.

    Raises:
        BadPicture: it is damaged, too large, or of a kind that needs Pillow.
    """
    chunks = chunks_of(data)
    if "IHDR" not in chunks or len(chunks["IHDR"]) != 13 or "IDAT" not in chunks:
        raise BadPicture("is a PNG without a head or without pixels; copy it again")
    columns, rows, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", chunks["IHDR"])
    check_size(columns, rows, MOST, f", and larger ones with Pillow: {how_to_install('images')}")
    if depth not in _DEPTHS.get(colour, ()):
        raise BadPicture(f"is a PNG of colour type {colour} with {depth} bits, which does not exist")
    if interlaced:
        raise BadPicture(f"is an interlaced PNG, which needs Pillow: {how_to_install('images')}")
    channels = _CHANNELS[colour]
    wide = (columns * channels * depth + 7) // 8
    try:
        packed = zlib.decompressobj().decompress(chunks["IDAT"], rows * (wide + 1) + 1)
    except zlib.error as error:
        raise BadPicture(f"its pixels cannot be unpacked ({error}); copy it again") from None
    if len(packed) != rows * (wide + 1):
        raise BadPicture("has fewer or more pixels than its head states; copy it again")
    lines = np.frombuffer(packed, np.uint8).reshape(rows, wide + 1)
    values = _values(_unfiltered(lines, max(1, channels * depth // 8)), depth, columns * channels)
    return _shaded(values.reshape(rows, columns, channels), depth, colour, chunks)


def _shaded(values: npt.NDArray[np.uint16], depth: int, colour: int, chunks: dict[str, bytes]) -> Picture:
    if colour != _PALETTE:
        return Picture(values, 2**depth - 1, transparent=colour in (4, 6))
    table = np.frombuffer(chunks.get("PLTE", b""), np.uint8)
    table = table[: len(table) // 3 * 3].reshape(-1, 3)
    if values.max() >= len(table):
        raise BadPicture("uses colours outside its palette; save it again")
    told = np.frombuffer(chunks.get("tRNS", b""), np.uint8)[: len(table)]
    if len(told):
        clear = np.full((len(table), 1), 255, np.uint8)
        clear[: len(told), 0] = told
        table = np.hstack((table, clear))
    return Picture(table[values[..., 0]], 255, transparent=len(told) > 0)


def chunks_of(data: bytes) -> dict[str, bytes]:
    """Chunk contents by type, those of one type concatenated.

    Raises:
        BadPicture: a chunk is damaged, or the last one is missing.
    """
    found: dict[str, list[bytes]] = {}
    at = len(SIGNATURE)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, content = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        crc = data[at + 8 + length : at + 12 + length]
        if len(crc) < 4 or zlib.crc32(kind + content) != int.from_bytes(crc, "big"):
            raise BadPicture("is damaged (checksum), or cut off; copy it again")
        found.setdefault(kind.decode("latin-1"), []).append(content)
        if kind == b"IEND":
            return {name: b"".join(parts) for name, parts in found.items()}
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
            raise BadPicture(f"uses the unknown filter {kind}; save it again")
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


def _values(lines: npt.NDArray[np.uint8], depth: int, count: int) -> npt.NDArray[np.uint16]:
    """Samples of each line as integers."""
    if depth == 16:
        return lines.view(">u2").astype(np.uint16)
    if depth == 8:
        return lines.astype(np.uint16)
    bits = np.unpackbits(lines, axis=1)
    size = bits.shape[1] // depth
    weights = 1 << np.arange(depth - 1, -1, -1)
    return np.asarray((bits.reshape(len(lines), size, depth) * weights).sum(axis=2)[:, :count], dtype=np.uint16)
