"""Damages the bytes of a sample block. Pure functions of the bytes, the fault and a random source."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from hal.fake.faults.orders import Fault

Harm = Callable[[bytes, Fault, Random], bytes]


def _stuck(data: bytes, _fault: Fault, _random: Random) -> bytes:
    return (data[:2] * (len(data) // 2 + 1))[: len(data)]


def _garbage(data: bytes, _fault: Fault, random: Random) -> bytes:
    return random.randbytes(len(data))


def _wrong(data: bytes, fault: Fault, _random: Random) -> bytes:
    by = int(fault.number("by"))
    words = [int.from_bytes(data[k : k + 2], "big") for k in range(0, len(data) - 1, 2)]
    return b"".join(min(max(word + by, 0), 4095).to_bytes(2, "big") for word in words) + data[2 * len(words) :]


def _short(data: bytes, fault: Fault, _random: Random) -> bytes:
    return data[: max(0, len(data) - int(fault.number("bytes")))]


def _released(data: bytes, fault: Fault, _random: Random) -> bytes:
    kept = 2 * int(0.5 * len(data) * fault.number("at"))
    return data[:kept] + b"\xff" * (len(data) - kept)


def _floats(data: bytes, _fault: Fault, _random: Random) -> bytes:
    return b"\xff" * len(data)


def _shift(data: bytes, fault: Fault, _random: Random) -> bytes:
    """Shift the bits, as after lost clocks; the missing bits at the end read 1."""
    bits = int(fault.number("bits"))
    number = (int.from_bytes(data, "big") << bits) | ((1 << bits) - 1)
    return (number & ((1 << 8 * len(data)) - 1)).to_bytes(len(data), "big")


def _hit(data: bytes, fault: Fault, _random: Random) -> bytes:
    """Invert bits of single words."""
    count, mask = len(data) // 2, int(fault.number("mask"))
    words = min(int(fault.number("words")), count)
    out = bytearray(data)
    for k in range(words):
        at = 2 * (count * (2 * k + 1) // (2 * words))
        out[at] ^= mask >> 8
        out[at + 1] ^= mask & 0xFF
    return bytes(out)


DAMAGE: dict[str, Harm] = {
    "stuck": _stuck,
    "garbage": _garbage,
    "wrong": _wrong,
    "hit": _hit,
    "shift": _shift,
    "released": _released,
    "floats": _floats,
    "short": _short,
}
"""In the order in which they are applied."""
