"""Damages the bytes of one reply. Pure functions of the bytes, the fault and a random source."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from hal.fake.faults.orders import Fault

HEAD_LINES = 2
"""Echo and status; data lines follow, and an empty line ends the reply."""


def _lines(reply: bytes) -> list[bytes]:
    return reply.split(b"\n")


def _spans(reply: bytes) -> list[tuple[int, int]]:
    """Begin and end of each line without its LF."""
    spans, at = [], 0
    for line in _lines(reply):
        spans.append((at, at + len(line)))
        at += len(line) + 1
    return spans


def _data_line(reply: bytes, chance: Random) -> int:
    """Number of a random data line; the last line of a reply without data."""
    count = len(_lines(reply)) - 2  # two empty strings follow the last line
    first = min(HEAD_LINES + (1 if count > HEAD_LINES + 1 else 0), count - 1)
    return chance.randrange(first, count)


def bit_flip(reply: bytes, fault: Fault, chance: Random) -> bytes:
    """Invert a bit in the part of the reply that the fault names."""
    part = fault.text("part")
    spans = _spans(reply)
    if part in ("data", "sum"):
        begin, end = spans[_data_line(reply, chance)]
    else:
        begin, end = spans[{"echo": 0, "status": 1, "stamp": 2}[part]]
    at = end - 1 if part == "sum" else chance.randrange(begin, max(begin + 1, end - 1))
    bit = int(fault.number("bit"))
    out = bytearray(reply)
    out[at] ^= 1 << (chance.randrange(8) if bit < 0 else bit)
    return bytes(out)


def garbage(reply: bytes, _fault: Fault, chance: Random) -> bytes:
    """Random bytes, as many as the reply had."""
    return chance.randbytes(len(reply))


def drop_byte(reply: bytes, _fault: Fault, chance: Random) -> bytes:
    """Lose one byte anywhere."""
    at = chance.randrange(len(reply))
    return reply[:at] + reply[at + 1 :]


def drop_line(reply: bytes, _fault: Fault, chance: Random) -> bytes:
    """Lose one data line."""
    lines = _lines(reply)
    del lines[_data_line(reply, chance)]
    return b"\n".join(lines)


def duplicate_line(reply: bytes, _fault: Fault, chance: Random) -> bytes:
    """Send one data line twice."""
    lines = _lines(reply)
    at = _data_line(reply, chance)
    return b"\n".join([*lines[: at + 1], *lines[at:]])


def cut_frame(reply: bytes, _fault: Fault, chance: Random) -> bytes:
    """Truncate at a random place; the empty line that ends a reply is always lost."""
    return reply[: chance.randrange(1, len(reply) - 1)]


def splice(reply: bytes, foreign: bytes, chance: Random) -> bytes:
    """Insert another reply between two bytes of this one."""
    at = chance.randrange(1, len(reply) - 1)
    return reply[:at] + foreign + reply[at:]


DAMAGE: dict[str, Callable[[bytes, Fault, Random], bytes]] = {
    "bit_flip": bit_flip,
    "drop_byte": drop_byte,
    "drop_line": drop_line,
    "duplicate_line": duplicate_line,
    "cut_frame": cut_frame,
    "garbage": garbage,
}
