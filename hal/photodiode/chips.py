"""Descriptions of the supported converters, and their look-up by name."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, cast

CLOCKS_PER_WORD: Final = 18
"""SCL clocks of one 16-bit word with its two acknowledgements: the time between two conversions."""
FIRST_CLOCK: Final = 8
"""The first conversion begins with the falling SCL edge after the R/W bit, this many clocks after START."""
CLOCKS_AROUND: Final = 10
"""START, the address byte with its acknowledgement, and STOP."""


@dataclass(frozen=True, slots=True)
class Query:
    """A register read: ``select`` is written, then ``length`` bytes are read."""

    select: bytes
    length: int


Mismatch = Callable[[tuple[bytes | None, ...]], str]
"""Maps the replies to the queries (None: not acknowledged) to why it is another chip; empty where it is this one."""


@dataclass(frozen=True, slots=True)
class BlockChip:
    """A converter whose conversions are clocked by SCL, so that one long read is one uniform block.

    Attributes:
        addresses: possible 7-bit addresses. bits: of a conversion, straight binary, full scale is the supply.
        spare: mask of the bits of a word that are always 0. scl_max_hz: fastest SCL of the data sheet.
        queries, mismatch: identify the chip. setup: messages that make it deliver conversions.
    """

    name: str
    addresses: frozenset[int]
    bits: int
    spare: int
    scl_max_hz: float
    queries: tuple[Query, ...]
    mismatch: Mismatch
    setup: tuple[bytes, ...] = ()


_CHIPS: Final = {
    "mcp3221": "hal.photodiode.mcp3221:CHIP",
    "adc121c021": "hal.photodiode.adc121c021:ADC121C021",
    "adc121c027": "hal.photodiode.adc121c021:ADC121C027",
}
_LEVEL_ONLY: Final = ("ads1015", "ads1115")


def chip_named(name: str) -> BlockChip:
    """The converter called ``name``, in any case of letters.

    Raises:
        ValueError: unknown, or not readable in uniform blocks.
    """
    known = ", ".join(_CHIPS)
    if name.lower() in _LEVEL_ONLY:
        raise ValueError(
            f"converter {name}: it samples by its own clock, so it measures levels only; to decode lamps use "
            f"one of {known}"
        )
    if name.lower() not in _CHIPS:
        raise ValueError(f"converter {name}: unknown; supported are {known}")
    module, _, attribute = _CHIPS[name.lower()].partition(":")
    return cast(BlockChip, getattr(importlib.import_module(module), attribute))
