"""SCIP scan requests and the decoding of their payloads into arrays. Pure, numpy only.

Source: SCIP 2.0 specification C-42-03320B, sections GD/GS/MD/MS; multi-echo and intensity forms as in the supplements
for UTM-30LX-EW and UXM-30LX-EW (C-42-03907). A payload is cut into lines of 64 characters wherever that falls: values
straddle lines.

A sum modulo 64 misses bits 6 and 7 and errors that cancel. Each character must therefore also lie in 0x30..0x6F, every
line but the last must be full, the number of steps must match the request, and the echo must be ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.hokuyo.scip import ACCEPTED, DATA, LINE_PAYLOAD, BadFrame, Flaw, Reply, checksum, decode_number

Ints = npt.NDArray[np.int32]

MAX_ECHOES: Final = 3
_LINE: Final = LINE_PAYLOAD + 2  # payload, sum, LF
_STAMP_LINE: Final = 6
_AMPERSAND: Final = 0x26


@dataclass(frozen=True, slots=True)
class _Form:
    """Characters per distance, whether an intensity follows each, whether ``&`` may add echoes."""

    chars: int
    intensity: bool
    echoes: bool

    @property
    def unit(self) -> int:
        return self.chars * (2 if self.intensity else 1)


_FORMS: Final = {
    "S": _Form(2, False, False),  # MS, GS
    "D": _Form(3, False, False),  # MD, GD
    "E": _Form(3, True, False),  # ME, GE
    "ND": _Form(3, False, True),
    "HD": _Form(3, False, True),
    "NE": _Form(3, True, True),
    "HE": _Form(3, True, True),
}
_STREAMS: Final = frozenset({"MD", "MS", "ME", "ND", "NE"})
_SINGLES: Final = frozenset({"GD", "GS", "GE", "HD", "HE"})


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """A scan command and the shape of its replies.

    Attributes:
        name: MD MS ME ND NE (stream) or GD GS GE HD HE (latest scan once, laser must be on).
        start, end: steps, both included.
        cluster: adjacent steps put together; their smallest distance is reported. 0 and 1: none.
        skip: scans left out between two sent, 0..9 (streams). count: scans wanted, 0 for endless (streams).
        tag: user string echoed by the sensor.

    Raises:
        ValueError: a field out of the range of its digits, or start after end.
    """

    name: str
    start: int
    end: int
    cluster: int = 1
    skip: int = 0
    count: int = 0
    tag: str = ""

    def __post_init__(self) -> None:
        if self.name not in _STREAMS | _SINGLES:
            raise ValueError(f"{self.name!r} is not a scan command")
        for field, most in (("start", 9999), ("end", 9999), ("cluster", 99), ("skip", 9), ("count", 99)):
            if not 0 <= getattr(self, field) <= most:
                raise ValueError(f"{field}={getattr(self, field)}: expected 0..{most}")
        if self.start > self.end:
            raise ValueError(f"start={self.start} lies after end={self.end}")

    @property
    def streaming(self) -> bool:
        """True for commands that are acknowledged first and then answered once per scan."""
        return self.name in _STREAMS

    @property
    def form(self) -> _Form:
        """Shape of the payload."""
        return _FORMS[self.name] if self.name in _FORMS else _FORMS[self.name[1]]

    @property
    def stride(self) -> int:
        """Steps between two beams of a reply."""
        return max(1, self.cluster)

    @property
    def beams(self) -> tuple[int, int]:
        """Least and most beams of a reply: implementations drop or keep an incomplete last cluster."""
        steps = self.end - self.start + 1
        return steps // self.stride, -(-steps // self.stride)

    @property
    def whole_groups(self) -> int:
        """Beams with a full group of steps. An incomplete last group has its middle elsewhere and is left out."""
        return max(1, self.beams[0])

    @property
    def echo(self) -> bytes:
        """The command line without LF, as the acknowledgement repeats it."""
        line = b"%s%04d%04d%02d" % (self.name.encode(), self.start, self.end, self.cluster)
        if self.streaming:
            line += b"%01d%02d" % (self.skip, self.count)
        return line + b";" + self.tag.encode("ascii") if self.tag else line

    def command(self) -> bytes:
        """The line to send."""
        return self.echo + b"\n"

    def remaining(self, echo: bytes) -> int:
        """Scans still to come, as a data reply's echo counts them down; 0 for an endless stream.

        Raises:
            BadFrame: ECHO, the reply belongs to another command.
        """
        ours = self.echo
        if not self.streaming or self.count == 0:
            if echo != ours:
                raise BadFrame(Flaw.ECHO, repr(echo[:40]))
            return 0
        digits = echo[13:15]
        if echo[:13] != ours[:13] or echo[15:] != ours[15:] or not digits.isdigit() or int(digits) >= self.count:
            raise BadFrame(Flaw.ECHO, repr(echo[:40]))
        return int(digits)

    @classmethod
    def of_echo(cls, echo: bytes) -> ScanRequest:
        """The request behind an echo, for captures without the host's commands.

        A counted stream counts as one that has just begun its last ``remaining + 1`` scans.

        Raises:
            BadFrame: ECHO, no scan command.
        """
        line, _, tag = echo.partition(b";")
        name, digits = line[:2].decode("ascii", "replace"), line[2:]
        if not digits.isdigit() or len(digits) != (13 if name in _STREAMS else 10) or not tag.isascii():
            raise BadFrame(Flaw.ECHO, repr(echo[:40]))
        count = int(digits[11:13] or 0)
        try:
            return cls(
                name,
                int(digits[0:4]),
                int(digits[4:8]),
                int(digits[8:10]),
                int(digits[10:11] or 0),
                count + 1 if count else 0,
                tag.decode("ascii"),
            )
        except ValueError as error:
            raise BadFrame(Flaw.ECHO, str(error)) from error

    @property
    def frame_bytes(self) -> int:
        """Length of one data reply on the wire, a single echo assumed."""
        chars = self.beams[1] * self.form.unit
        return len(self.echo) + 1 + 4 + _STAMP_LINE + chars + 2 * -(-chars // LINE_PAYLOAD) + 1


@dataclass(frozen=True, slots=True, eq=False)
class ScanReply:
    """One decoded scan, values as sent (codes below DMIN and values above DMAX included).

    Attributes:
        stamp: sensor clock in ms, 24 bits. remaining: scans still to come of a counted stream.
        distance: int32 (beams,), first echo, mm. intensity: int32 (beams,) of the first echo, or None.
        echoes: int32 (beams, 3), further echoes from column 0, 0 where none; None for single-echo commands.
        echo_intensity: int32 (beams, 3) that belong to ``echoes``, or None.
    """

    stamp: int
    remaining: int
    distance: Ints
    intensity: Ints | None = None
    echoes: Ints | None = None
    echo_intensity: Ints | None = None


def parse_scan(request: ScanRequest, reply: Reply) -> ScanReply:
    """Decode a data reply to ``request`` (status 99 of streams, 00 of single scans).

    Raises:
        BadFrame: a rule of the format is broken; a damaged frame yields no data.
    """
    if reply.status != (DATA if request.streaming else ACCEPTED):
        raise BadFrame(Flaw.STATUS, f"{reply.status} is not a data status")
    remaining = request.remaining(reply.echo)
    body = reply.body
    if len(body) < _STAMP_LINE or body[5] != 0x0A:
        raise BadFrame(Flaw.LAYOUT, "no time line")
    if checksum(body[:4]) != body[4]:
        raise BadFrame(Flaw.SUM, "time line")
    stamp = decode_number(body[:4])
    form = request.form
    sextets = _sextets(body, ampersands=form.echoes)
    if form.echoes:
        return _with_echoes(request, stamp, remaining, sextets)
    if len(sextets) % form.unit or len(sextets) // form.unit not in request.beams:
        raise BadFrame(Flaw.LENGTH, f"{len(sextets)} characters for {request.beams[1]} steps")
    values = _values(sextets, form.chars)
    if not form.intensity:
        return ScanReply(stamp, remaining, values)
    return ScanReply(stamp, remaining, values[0::2].copy(), values[1::2].copy())


def _sextets(body: bytes, *, ampersands: bool) -> npt.NDArray[np.uint8]:
    """Payload characters less 0x30 with lines joined, after every line's length, sum and characters were checked."""
    raw = np.frombuffer(body, np.uint8, offset=_STAMP_LINE)
    full = len(raw) // _LINE
    lines = raw[: full * _LINE].reshape(full, _LINE)
    rest = raw[full * _LINE :]
    if (lines[:, 65] != 0x0A).any() or (len(rest) and (len(rest) < 3 or rest[-1] != 0x0A)):
        raise BadFrame(Flaw.LAYOUT, "a line is not 64 characters, its sum and LF")
    chars = np.empty(full * LINE_PAYLOAD + max(0, len(rest) - 2), np.uint8)
    block = chars[: full * LINE_PAYLOAD].reshape(full, LINE_PAYLOAD)
    np.subtract(lines[:, :LINE_PAYLOAD], 0x30, out=block)
    np.subtract(rest[:-2], 0x30, out=chars[full * LINE_PAYLOAD :])
    # 64 characters less 0x30 each shift a sum by a multiple of 64; the rest line's by its own length
    sums = np.add.reduce(block, axis=1, dtype=np.uint8)
    wrong = bool(((sums & 0x3F) + 0x30 != lines[:, 64]).any())
    if len(rest):
        wrong = wrong or checksum(rest[:-2].tobytes()) != rest[-2]
    if wrong:
        raise BadFrame(Flaw.SUM, "data line")
    if chars.size and int(chars.max()) > 0x3F:
        bad = chars > 0x3F
        if not ampersands or (chars[bad] != (_AMPERSAND - 0x30) % 256).any():
            raise BadFrame(Flaw.CHARACTER, "in a data line")
    return chars


def _values(sextets: npt.NDArray[np.uint8], chars: int) -> Ints:
    """Numbers of ``chars`` characters each."""
    digits = sextets.reshape(-1, chars)
    values = digits[:, 0].astype(np.int32)
    for column in range(1, chars):
        values <<= 6
        values |= digits[:, column]
    return values


def _with_echoes(request: ScanRequest, stamp: int, remaining: int, chars: npt.NDArray[np.uint8]) -> ScanReply:
    """Decode multi-echo payloads: after ``&`` the next value (or distance and intensity) is of the same step."""
    form = request.form
    marks = np.flatnonzero(chars > 0x3F)
    sextets = np.delete(chars, marks)
    if len(sextets) % form.unit:
        raise BadFrame(Flaw.LENGTH, "a value is cut")
    units = len(sextets) // form.unit
    place = marks - np.arange(len(marks))  # position of each & after removal of all &
    extra = np.zeros(units, bool)
    if len(marks):
        unit_of_mark = place // form.unit
        if (place % form.unit).any() or unit_of_mark[0] == 0 or unit_of_mark[-1] >= units:
            raise BadFrame(Flaw.LENGTH, "& inside a value, or before or after all")
        if (np.diff(unit_of_mark) == 0).any():
            raise BadFrame(Flaw.LENGTH, "two & in a row")
        extra[unit_of_mark] = True
    step = np.cumsum(~extra) - 1
    first = np.flatnonzero(~extra)
    if len(first) not in request.beams:
        raise BadFrame(Flaw.LENGTH, f"{len(first)} steps for {request.beams[1]}")
    order = np.arange(units) - first[step]
    if order.size and int(order.max()) >= MAX_ECHOES:
        raise BadFrame(Flaw.LENGTH, "more than three echoes")
    values = _values(sextets, form.chars)
    distance = values[0::2] if form.intensity else values
    amplitude = values[1::2] if form.intensity else None

    def further(of: Ints) -> Ints:
        table = np.zeros((len(first), MAX_ECHOES), np.int32)
        table[step[extra], order[extra] - 1] = of[extra]
        return table

    return ScanReply(
        stamp,
        remaining,
        distance[first],
        None if amplitude is None else amplitude[first],
        further(distance),
        None if amplitude is None else further(amplitude),
    )
