"""Converts the bytes of one block to words and finds their defects: rails, stuck, shifted or missing words. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.adc import Blemish

STUCK_RUN: Final = 64
"""A run of this many equal words, not at a rail, is no live signal (3 ms at 22 ksps)."""
RAIL_BITS: Final = 7
"""Words within 1/128 of the range of a rail count as clipped: amplifiers stop up to 25 mV short of their supply."""
QUIET_WORDS: Final = 1.5
"""Standard deviation of a block (words) below which it holds only the converter's own noise (0.5 words)."""
RELEASED: Final = 0xFFFF
"""Word of a released bus: every bit is 1."""


@dataclass(frozen=True, slots=True)
class BlockDefects:
    """Defects of one block, counted, for the diagnosis over many blocks.

    Attributes:
        clipped: share of words at a rail. misaligned: share of words with spare bits set.
        stuck: whether one value, not at a rail, makes up a run of at least STUCK_RUN words.
        constant: whether the whole block is one value, wherever that is.
        quiet: the block holds only the converter's own noise, and is not at a rail.
        floated: every bit of the block is 1.
    """

    clipped: float = 0.0
    misaligned: float = 0.0
    stuck: bool = False
    constant: bool = False
    quiet: bool = False
    floated: bool = False


def inspect(data: bytes, requested: int, spare: int, bits: int) -> tuple[npt.NDArray[np.uint16], Blemish, BlockDefects]:
    """Return the words of a block, right-aligned, its blemishes and the counted defects.

    Trailing words with every bit set were not sent by the chip and are cut off.

    Args:
        data: as read.
        requested: bytes of the read.
        spare: bits of a word that are always 0.
        bits: of a conversion.
    """
    raw = np.frombuffer(data, dtype=">u2", count=len(data) // 2).astype(np.uint16)
    blemish = Blemish.NONE
    floated = raw.size > 0 and bool((raw == RELEASED).all())
    if not floated:
        raw = raw[: raw.size - _released_at_end(raw)]
    if raw.size < requested // 2:
        blemish |= Blemish.SHORT
    if raw.size == 0:
        return raw, blemish, BlockDefects()
    misaligned = int(np.count_nonzero(raw & np.uint16(spare)))
    top = (1 << bits) - 1
    words = raw & np.uint16(top)
    defects = _count(words, top, misaligned / raw.size, floated)
    if defects.clipped and not floated:
        blemish |= Blemish.CLIPPED
    if misaligned:
        blemish |= Blemish.MISALIGNED
    if defects.stuck:
        blemish |= Blemish.STUCK
    return words, blemish, defects


def _released_at_end(raw: npt.NDArray[np.uint16]) -> int:
    alive = np.flatnonzero(raw != RELEASED)
    return raw.size - 1 - int(alive[-1]) if alive.size else raw.size


def _count(words: npt.NDArray[np.uint16], top: int, misaligned: float, floated: bool) -> BlockDefects:
    margin = (top + 1) >> RAIL_BITS
    at_rail = (words <= margin) | (words >= top - margin)
    starts = np.concatenate(([0], np.flatnonzero(words[1:] != words[:-1]) + 1))
    lengths = np.diff(starts, append=words.size)
    longest = int(lengths[~at_rail[starts]].max(initial=0))
    return BlockDefects(
        clipped=float(np.count_nonzero(at_rail)) / words.size,
        misaligned=misaligned,
        stuck=longest >= min(STUCK_RUN, max(words.size, 2)),
        constant=starts.size == 1 < words.size,
        quiet=not at_rail.any() and float(np.std(words)) < QUIET_WORDS,
        floated=floated,
    )
