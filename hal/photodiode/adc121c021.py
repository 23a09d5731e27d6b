"""The ADC121C021 and ADC121C027 converters: 12 bits, one input, registers behind a pointer (TI SNAS415).

The first byte of a write sets the pointer, which then stays. With the pointer at the conversion result, a read in
normal mode (automatic conversion off) starts a conversion; each further acknowledged pair of bytes is the next one.
A result word is the alert flag (0 while alerts are disabled), three zeros, D11..D0.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from hal.photodiode.chips import BlockChip, Query


class Register(IntEnum):
    """Values of the address pointer."""

    CONVERSION = 0
    ALERT_STATUS = 1
    CONFIGURATION = 2
    LOW_LIMIT = 3
    HIGH_LIMIT = 4
    HYSTERESIS = 5
    LOWEST = 6
    HIGHEST = 7


_RESERVED_CONFIGURATION: Final = 0b0000_0010  # D1 must be zero
_LIMITS: Final = (Register.LOW_LIMIT, Register.HIGH_LIMIT, Register.HYSTERESIS)
_NORMAL_MODE: Final = bytes([Register.CONFIGURATION, 0])
_SELECT_CONVERSION: Final = bytes([Register.CONVERSION])


def mismatch(answers: tuple[bytes | None, ...]) -> str:
    """Text where the registers cannot be read or have reserved bits set: then it is another chip."""
    if any(answer is None for answer in answers):
        return "has no registers, an ADC121C021 has eight"
    configuration, *limits = [int.from_bytes(answer or b"", "big") for answer in answers]
    if configuration & _RESERVED_CONFIGURATION:
        return f"has {configuration:#04x} in its configuration, where an ADC121C021 has bit 1 at zero"
    for register, value in zip(_LIMITS, limits, strict=True):
        if value & 0xF000:
            return f"has {value:#06x} in register {int(register)}, where an ADC121C021 has four zeros at the top"
    return ""


def _chip(name: str, addresses: set[int]) -> BlockChip:
    return BlockChip(
        name=name,
        addresses=frozenset(addresses),
        bits=12,
        spare=0xF000,
        scl_max_hz=3.4e6,
        queries=(
            Query(bytes([Register.CONFIGURATION]), 1),
            *(Query(bytes([register]), 2) for register in _LIMITS),
        ),
        mismatch=mismatch,
        setup=(_NORMAL_MODE, _SELECT_CONVERSION),
    )


ADC121C021: Final = _chip("ADC121C021", {0x50, 0x51, 0x52, 0x54, 0x55, 0x56, 0x58, 0x59, 0x5A})
"""SOT package: always 0x54; VSSOP: set by two pins."""
ADC121C027: Final = _chip("ADC121C027", {0x50, 0x51, 0x52})
