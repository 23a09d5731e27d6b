"""The ADS1015 and ADS1115 converters: delta-sigma, with an oscillator of their own (TI SBAS473, SBAS444).

They serve the DC channel only: data rates are accurate to 10 %, and a faster read repeats the latest result. Four
16-bit registers lie behind a pointer that stays: conversion, configuration, low and high threshold. Results are two's
complement with full scale at 32768; the ADS1015 leaves the lowest four bits at zero.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from hal.photodiode.chips import Query

ADDRESSES: Final = frozenset(range(0x48, 0x4C))
"""ADDR pin at GND, VDD, SDA, SCL."""
RANGES_V: Final = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256)
"""Full scales by PGA code; codes 5 to 7 are all 0.256 V."""
RATES: Final = {
    "ADS1015": (128, 250, 490, 920, 1600, 2400, 3300, 3300),
    "ADS1115": (8, 16, 32, 64, 128, 250, 475, 860),
}
"""Samples per second by DR code."""
_IDLE: Final = 0x8000
_RESET: Final = 0x8583
_MARK: Final = 0b10111
"""Low bits of our configurations: comparator off (00011). The others (window, latch) then have no effect: other
programs leave them at 0, so that a configuration of theirs differs from ours even with the same input."""


class Register(IntEnum):
    """Values of the pointer."""

    CONVERSION = 0
    CONFIGURATION = 1
    LOW_THRESHOLD = 2
    HIGH_THRESHOLD = 3


RESULT: Final = Query(bytes([Register.CONVERSION]), 2)
QUERIES: Final = (Query(bytes([Register.LOW_THRESHOLD]), 2), Query(bytes([Register.HIGH_THRESHOLD]), 2))
READ_BACK: Final = Query(bytes([Register.CONFIGURATION]), 2)


@dataclass(frozen=True, slots=True)
class Configuration:
    """The configuration register, comparator off and marked as ours.

    Attributes:
        channel: AIN0 to AIN3 against ground. pga: index into :data:`RANGES_V`. rate: DR code.
        single: convert once per start bit (the state after reset); else continuously.
        start: with ``single``, start a conversion by this write.
    """

    channel: int = 0
    pga: int = 1
    rate: int = 4
    single: bool = False
    start: bool = False

    def word(self) -> int:
        """The 16-bit word; raises `ValueError` for a field out of its range."""
        for name, value, count in (("channel", self.channel, 4), ("pga", self.pga, 8), ("rate", self.rate, 8)):
            if not 0 <= value < count:
                raise ValueError(f"{name} {value}: expected 0 to {count - 1}")
        fields = (self.start << 15) | ((4 + self.channel) << 12) | (self.pga << 9)
        return fields | (self.single << 8) | (self.rate << 5) | _MARK

    def message(self) -> bytes:
        """The bytes of the write: pointer and word."""
        return struct.pack(">BH", Register.CONFIGURATION, self.word())

    @property
    def full_scale_v(self) -> float:
        """Voltage at which the result saturates."""
        return RANGES_V[min(self.pga, 5)]


def after_reset(answer: bytes) -> bool:
    """Whether a configuration is the one after a reset of the chip; bit 15 as in :func:`same_configuration`."""
    return len(answer) == 2 and (int.from_bytes(answer, "big") ^ _RESET) & ~_IDLE == 0


def same_configuration(answer: bytes, wanted: Configuration) -> bool:
    """Whether the chip has the configuration; bit 15 has another meaning when read (idle or converting)."""
    return len(answer) == 2 and (int.from_bytes(answer, "big") ^ wanted.word()) & ~_IDLE == 0


def mismatch(answers: tuple[bytes | None, ...]) -> str:
    """Text where the thresholds are neither those after reset nor those of a conversion-ready pin."""
    if any(answer is None for answer in answers):
        return "has no registers, an ADS1x15 has four"
    low, high = (int.from_bytes(answer or b"", "big") for answer in answers)
    if (low, high) == (0x8000, 0x7FFF) or (high & 0x8000 and not low & 0x8000):
        return ""
    return f"has thresholds {low:#06x} and {high:#06x}, an ADS1x15 has 0x8000 and 0x7fff after a reset"


def fraction(answer: bytes) -> float:
    """A conversion result as a fraction of full scale, -1 to 1."""
    (value,) = struct.unpack(">h", answer)
    return float(value) / 32768.0
