"""SCIP protocol codec: commands, frames, replies, checksums. Pure functions, no I/O, no clock.

Source: HOKUYO "Communication Protocol Specification for SCIP 2.0 Standard" (C-42-03320B) and the SCIP 2.2 supplements
of the UST series (C-42-04076). Host lines end in LF; every reply ends in an empty line, so that ``LF LF`` is both the
delimiter and the mark at which a reader resynchronises. Scan payloads: :mod:`hal.hokuyo.payload`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from typing import Final

TICK_MODULUS: Final = 1 << 24
"""The sensor's clock counts milliseconds in 24 bits: it wraps every 4 h 39 min 37.216 s."""

MAX_LINE: Final = 256  # scan lines have 66 bytes at most, text lines of VV and II more
MAX_FRAME: Final = 32768  # the longest legal reply (NE, 1081 steps, three echoes) has 22 323 bytes
LINE_PAYLOAD: Final = 64

ACCEPTED: Final = "00"
DATA: Final = "99"
RESUMED: Final = "98"  # streaming again after a self-check
ABNORMAL: Final = "0L"  # SCIP 2.2: only RB and state queries are accepted
UNSTABLE: Final = "0M"  # SCIP 2.2: not stable yet after the start
NOT_NOW: Final = frozenset({"0E", "10", UNSTABLE})  # refused at present: time-adjust mode, or starting up

VV: Final = b"VV\n"
PP: Final = b"PP\n"
II: Final = b"II\n"
BM: Final = b"BM\n"
QT: Final = b"QT\n"
RS: Final = b"RS\n"
RT: Final = b"RT\n"
RB: Final = b"RB\n"
TM_READ: Final = b"TM1\n"
TM_LEAVE: Final = b"TM2\n"
TO_SCIP2: Final = b"SCIP2.0\n"

BAUD_RATES: Final = (19200, 38400, 57600, 115200, 250000, 500000, 750000)
"""Rates of RS-232 models, in the order in which they are tried (factory default first)."""


class Flaw(Enum):
    """Why a frame is unusable."""

    LAYOUT = "lines are missing, cut or of the wrong length"
    STATUS = "no valid status line"
    SUM = "checksum"
    CHARACTER = "character that SCIP does not use"
    ECHO = "echo of another command"
    LENGTH = "wrong number of steps"
    TEXT = "invalid text line"


class BadFrame(ValueError):
    """A frame that violates the protocol; ``flaw`` is the broken rule, the text gives the place."""

    def __init__(self, flaw: Flaw, detail: str = "") -> None:
        super().__init__(f"{flaw.value}: {detail}" if detail else flaw.value)
        self.flaw = flaw


def checksum(payload: bytes) -> int:
    """Sum character of a line: six low bits of the byte sum, plus 0x30 (SCIP 2.0 spec, section 4)."""
    return (sum(payload) & 0x3F) + 0x30


def decode_number(chars: bytes) -> int:
    """Value of big-endian 6-bit characters ``0`` (0x30) to ``o`` (0x6F); raises `BadFrame` for any other character."""
    value = 0
    for char in chars:
        if not 0x30 <= char <= 0x6F:
            raise BadFrame(Flaw.CHARACTER, repr(bytes([char])))
        value = value << 6 | char - 0x30
    return value


_STATUS = re.compile(rb"[0-9][0-9A-Z]")  # stricter than the sum, which ignores bits 6 and 7
_UNPRINTABLE = re.compile(rb"[^ -~]")
_TAG = re.compile(rb"[A-Za-z0-9 ._+@]{0,16}\Z")


def tagged(command: bytes, tag: str) -> bytes:
    """``command`` with a user string after ``;``, which the sensor echoes; pairs replies with requests.

    Raises:
        ValueError: longer than 16 characters, or other than letters, digits, space and ``. _ + @``.
    """
    text = tag.encode("ascii", "replace")
    if not _TAG.match(text):
        raise ValueError(f"user string {tag!r}: at most 16 letters, digits, spaces or . _ + @")
    return command.removesuffix(b"\n") + b";" + text + b"\n"


def baud_command(baud: int) -> bytes:
    """``SS``: change the RS-232 rate; the answer still comes at the old one. Raises `ValueError` for other rates."""
    if baud not in BAUD_RATES:
        raise ValueError(f"{baud} bit/s: SCIP has {', '.join(map(str, BAUD_RATES))}")
    return b"SS%06d\n" % baud


class FrameSplitter:
    """Cuts a byte stream into frames at ``LF LF``; keeps at most one frame of memory whatever arrives.

    Bytes that cannot be SCIP (a line without end, a frame without end) are dropped up to the next ``LF LF`` and counted
    in :attr:`dropped_bytes`.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._scan_from = 0
        self._skipping = False
        self.dropped_bytes = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Frames completed by ``data``, oldest first, without their ``LF LF`` and without stray empty lines before."""
        buffer = self._buffer
        buffer += data
        frames: list[bytes] = []
        start = 0
        end = buffer.find(b"\n\n", self._scan_from)
        while end >= 0:
            frame = bytes(buffer[start:end]).lstrip(b"\n")
            if self._skipping or len(frame) > MAX_FRAME:
                self.dropped_bytes += end + 2 - start
            elif frame:
                frames.append(frame)
            self._skipping = False
            start = end + 2
            end = buffer.find(b"\n\n", start)
        if start:
            del buffer[:start]
        self._bound()
        self._scan_from = max(0, len(buffer) - 1)  # an LF at the end may be the first of two
        return frames

    def reset(self) -> None:
        """Drop an incomplete frame (a new stream begins)."""
        self.dropped_bytes += len(self._buffer)
        self._buffer.clear()
        self._scan_from = 0
        self._skipping = False

    def _bound(self) -> None:
        buffer = self._buffer
        endless_line = len(buffer) - (buffer.rfind(b"\n") + 1) > MAX_LINE
        if endless_line or len(buffer) > MAX_FRAME or (self._skipping and len(buffer) > 1):
            keep = 1 if buffer.endswith(b"\n") else 0
            self.dropped_bytes += len(buffer) - keep
            del buffer[: len(buffer) - keep]
            self._skipping = True


@dataclass(frozen=True, slots=True)
class Reply:
    """One frame, split into the parts that all replies have.

    Attributes:
        echo: the command line as the sensor repeats it.
        status: two characters; in SCIP 1.1 one (``0`` success, anything else refusal).
        body: the lines after the status, each with its LF; not yet checked.
        legacy: the status has no checksum: the sensor uses SCIP 1.1.
    """

    echo: bytes
    status: str
    body: bytes
    legacy: bool = False


def parse_reply(frame: bytes) -> Reply:
    """Split a frame and check its status line.

    Raises:
        BadFrame: STATUS where it is missing, SUM where its checksum is wrong.
    """
    first = frame.find(b"\n")
    if first < 0:
        raise BadFrame(Flaw.STATUS, "a single line")
    second = frame.find(b"\n", first + 1)
    line = frame[first + 1 :] if second < 0 else frame[first + 1 : second]
    body = b"" if second < 0 else frame[second + 1 :] + b"\n"
    if len(line) == 1 and line.isalnum():
        return Reply(frame[:first], line.decode("ascii"), body, legacy=True)
    if len(line) != 3 or not _STATUS.match(line):
        raise BadFrame(Flaw.STATUS, repr(line[:8]))
    if checksum(line[:2]) != line[2]:
        raise BadFrame(Flaw.SUM, f"status {line!r}")
    return Reply(frame[:first], line[:2].decode("ascii"), body)


def parse_stamp(reply: Reply) -> int:
    """Clock in ms of a ``TM1`` reply. Raises `BadFrame` where its one line is not four characters and their sum."""
    line = reply.body
    if len(line) != 6 or line[5] != 0x0A:
        raise BadFrame(Flaw.LAYOUT, f"time line {line[:8]!r}")
    if checksum(line[:4]) != line[4]:
        raise BadFrame(Flaw.SUM, f"time line {line!r}")
    return decode_number(line[:4])


def parse_text(reply: Reply, *, strict: bool = True) -> dict[str, str]:
    """``KEY:value;s`` lines of VV, PP and II.

    Firmware versions differ in the summed bytes: without the ``;`` (the rule), with it, or up to ``<-``; all are valid.
    A line without a colon is skipped. ``value`` may contain ``;``: the last one ends it. A character that is not
    printable ASCII becomes ``?``.

    Args:
        reply: an accepted reply.
        strict: False accepts what a firmware sends repeatedly (the same bytes came twice): lines whose sum fits none of
            the three, and bytes above 127, as in a vendor's name. Lines without an end are then skipped.

    Raises:
        BadFrame: SUM, TEXT, CHARACTER; only where ``strict``.
    """
    found: dict[str, str] = {}
    for line in reply.body.removesuffix(b"\n").split(b"\n") if reply.body else ():
        if strict:
            _check_text(line)
        key, colon, value = line[:-2].partition(b":")
        if colon and line[-2:-1] == b";":
            found[_readable(key)] = _readable(value)
    return found


def _check_text(line: bytes) -> None:
    if len(line) < 2 or line[-2:-1] != b";":
        raise BadFrame(Flaw.TEXT, repr(line[:40]))
    if not line.isascii():
        raise BadFrame(Flaw.CHARACTER, repr(line[:40]))
    if line[-1] not in _text_sums(line):
        raise BadFrame(Flaw.SUM, f"text line {line!r}")


def _readable(text: bytes) -> str:
    return _UNPRINTABLE.sub(b"?", text.strip()).decode("ascii")


def _text_sums(line: bytes) -> set[int]:
    sums = {checksum(line[:-2]), checksum(line[:-1])}
    arrow = line.rfind(b"<-")
    if arrow >= 0:
        sums.add(checksum(line[: arrow + 2]))
    return sums
