"""What the sampler has to know of a converter, and the converters there are."""

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
    """A register to be read: ``select`` is written, then ``length`` bytes are read."""

    select: bytes
    length: int


Judge = Callable[[tuple[bytes | None, ...]], str]
"""Answers to the queries (None: not acknowledged) to what speaks against this chip; empty if nothing does."""


@dataclass(frozen=True, slots=True)
class BlockChip:
    """A converter whose conversions are clocked by SCL, so that one long read is one uniform block.

    Attributes:
        addresses: 7-bit addresses it can have. bits: of a conversion, straight binary, full scale is the supply.
        spare: mask of the bits of a word that are always 0. scl_max_hz: fastest SCL its data sheet allows.
        queries, judge: how to find out whether it is this chip. setup: messages that make it deliver conversions.
    """

    name: str
    addresses: frozenset[int]
    bits: int
    spare: int
    scl_max_hz: float
    queries: tuple[Query, ...]
    judge: Judge
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
        ValueError: there is none, or it cannot be read in uniform blocks.
    """
    known = ", ".join(_CHIPS)
    if name.lower() in _LEVEL_ONLY:
        raise ValueError(
            f"chip {name}: samples by a clock of its own, so it tells levels only; decode lights with one of {known}"
        )
    if name.lower() not in _CHIPS:
        raise ValueError(f"chip {name}: not known; known are {known}")
    module, _, attribute = _CHIPS[name.lower()].partition(":")
    return cast(BlockChip, getattr(importlib.import_module(module), attribute))
