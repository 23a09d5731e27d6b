"""Minimal PNG encoder: 8-bit RGB, no interlace, one filter (ISO/IEC 15948)."""

from __future__ import annotations

import struct
import zlib
from typing import Final

import numpy as np
import numpy.typing as npt

SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_RGB: Final = 2
_UP: Final = 2


def encode_png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """PNG file of ``pixels``, uint8 (rows, columns, 3), top row first. The same pixels give the same bytes."""
    rows, columns, _ = pixels.shape
    above = np.zeros_like(pixels)
    above[1:] = pixels[:-1]
    lines = np.empty((rows, 1 + 3 * columns), np.uint8)
    lines[:, 0] = _UP  # each line holds its difference from the one above: maps are mostly uniform
    lines[:, 1:] = (pixels - above).reshape(rows, -1)
    head = struct.pack(">IIBBBBB", columns, rows, 8, _RGB, 0, 0, 0)
    data = zlib.compress(lines.tobytes(), 6)
    return SIGNATURE + _chunk(b"IHDR", head) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
