"""The sensor's SCIP 2.0 encoder, written from the specification (C-42-03320B).

Pure functions: numbers and text in, bytes out. The driver's codec is a separate implementation and is never imported
here, so that an error of one cannot hide an error of the other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

LINE = 64
"""Payload characters in a data line; a sum character and LF follow."""

MAX_3 = (1 << 18) - 1
MAX_4 = (1 << 24) - 1

Ints = npt.NDArray[np.int32]
Chars = npt.NDArray[np.uint8]


def checksum(payload: bytes) -> bytes:
    """The sum character of a line: low six bits of the byte sum, plus 0x30; the LF is not part of ``payload``."""
    return bytes([(sum(payload) & 0x3F) + 0x30])


def number(value: int, chars: int) -> bytes:
    """``value`` as ``chars`` six-bit characters, most significant first.

    Raises:
        ValueError: the value does not fit.
    """
    if not 0 <= value < 1 << (6 * chars):
        raise ValueError(f"{value} does not fit {chars} SCIP characters")
    return bytes((value >> shift & 0x3F) + 0x30 for shift in range(6 * (chars - 1), -1, -6))


def numbers(values: Ints, chars: int) -> Chars:
    """Encode an array of n values as uint8 of shape (n, ``chars``); values are clipped to their range."""
    clipped = np.clip(values, 0, (1 << (6 * chars)) - 1)
    out = np.empty((clipped.size, chars), dtype=np.uint8)
    for i in range(chars):
        out[:, i] = (clipped >> (6 * (chars - 1 - i))) & 0x3F
    out += 0x30
    return out


def data_lines(payload: bytes) -> bytes:
    """Cut ``payload`` into lines of 64 characters, each with its own sum character and LF."""
    chars = np.frombuffer(payload, dtype=np.uint8)
    full = chars.size // LINE
    block = np.empty((full, LINE + 2), dtype=np.uint8)
    block[:, :LINE] = chars[: full * LINE].reshape(full, LINE)
    block[:, LINE] = (block[:, :LINE].sum(axis=1, dtype=np.uint32) & 0x3F) + 0x30
    block[:, LINE + 1] = 0x0A
    rest = payload[full * LINE :]
    return block.tobytes() + (rest + checksum(rest) + b"\n" if rest else b"")


def summed_line(payload: bytes) -> bytes:
    """One line with its sum character: status, time stamp, state digits."""
    return payload + checksum(payload) + b"\n"


def text_line(key: str, value: str) -> bytes:
    """A ``KEY:value;s`` line of VV, PP and II, in Latin-1; the semicolon is not summed."""
    text = f"{key}:{value}".encode("latin-1")
    return text + b";" + checksum(text) + b"\n"


def text_line_summed_whole(key: str, value: str) -> bytes:
    """A firmware variant: the semicolon is summed, too."""
    text = f"{key}:{value};".encode("latin-1")
    return text + checksum(text) + b"\n"


def text_line_summed_to_mark(key: str, value: str) -> bytes:
    """A variant of UTM-30LX firmware: ``value<-remark`` is summed up to and including ``<-``."""
    text = f"{key}:{value}".encode("latin-1")
    mark = text.find(b"<-")
    summed = text[: mark + 2] if mark >= 0 else text
    return text + b";" + checksum(summed) + b"\n"


TEXT_SUMS = {"plain": text_line, "whole": text_line_summed_whole, "mark": text_line_summed_to_mark}
"""Checksum variants of text lines in firmware."""


def reply(echo: bytes, status: str, body: bytes = b"") -> bytes:
    """A whole reply: echo of the request, status line, lines of ``body``, empty line."""
    return echo + b"\n" + summed_line(status.encode("ascii")) + body + b"\n"


def measurement(tick: int, payload: bytes) -> bytes:
    """Body of a measurement reply: four-character time stamp in milliseconds, then the data lines."""
    return summed_line(number(tick & MAX_4, 4)) + data_lines(payload)


def short_distances(distance: Ints) -> bytes:
    """Payload of MS and GS: two characters a step, saturating at 4095 mm."""
    return numbers(distance, 2).tobytes()


def distances(distance: Ints) -> bytes:
    """Payload of MD and GD: three characters a step."""
    return numbers(distance, 3).tobytes()


def distances_intensities(distance: Ints, intensity: Ints) -> bytes:
    """Payload of ME and GE: distance and intensity, three characters each, step by step."""
    return np.concatenate((numbers(distance, 3), numbers(intensity, 3)), axis=1).tobytes()


def multi_echo(distance: Ints, further: Ints, intensity: Ints | None = None, weaker: Ints | None = None) -> bytes:
    """Payload of ND, HD (no ``intensity``) and NE, HE: further echoes of a step follow it, each behind a ``&``.

    Args:
        distance: first echoes, n values.
        further: shape (n, m), m <= 2, 0 where there is no such echo.
        intensity: of the first echoes.
        weaker: intensity of the further ones, shape as ``further``; sent as 0 where not given.
    """
    count, more = further.shape
    width = 3 if intensity is None else 6
    out = np.empty((count, 1 + more, 1 + width), dtype=np.uint8)
    keep = np.ones(out.shape, dtype=np.bool_)
    out[:, :, 0] = ord("&")
    keep[:, 0, 0] = False
    out[:, 0, 1:4] = numbers(distance, 3)
    for i in range(more):
        out[:, 1 + i, 1:4] = numbers(further[:, i], 3)
        keep[:, 1 + i, :] = (further[:, i] > 0)[:, None]
        if intensity is not None:
            out[:, 1 + i, 4:] = numbers(further[:, i] * 0 if weaker is None else weaker[:, i], 3)
    if intensity is not None:
        out[:, 0, 4:] = numbers(intensity, 3)
    return out[keep].tobytes()
