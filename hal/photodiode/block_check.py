"""Converts the bytes of one block to words and finds their defects: rails, stuck, shifted or missing words. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
SINGLE_SHARE: Final = 0.02
"""Largest share of damaged words of a block in which each damaged word is replaced."""
APART: Final = 8
"""Words between two damaged ones that are damages of single words; closer ones are a shift or a disturbance."""
EVEN_CHANGES: Final = 40
"""Changes of the value in a row of words with lowest bit 0: no chance (2**-40), though all upper bits fit."""
EVEN_VALUES: Final = 3
"""Different words of such a run: an input that only toggles has fewer."""


@dataclass(frozen=True, slots=True)
class BlockDefects:
    """Defects of one block, counted, for the diagnosis over many blocks.

    Attributes:
        clipped: share of words at a rail. misaligned: share of words with spare bits set, unless they are single ones
            and have been replaced, or of words whose lowest bits have been lost.
        lost_bits: clocks were lost, by the lowest bits. repaired: words that were replaced.
        stuck: whether one value, not at a rail, makes up a run of at least STUCK_RUN words.
        constant: whether the whole block is one value, wherever that is.
        quiet: the block holds only the converter's own noise, and is not at a rail.
        floated: every bit of the block is 1.
    """

    clipped: float = 0.0
    misaligned: float = 0.0
    lost_bits: bool = False
    repaired: int = 0
    stuck: bool = False
    constant: bool = False
    quiet: bool = False
    floated: bool = False


def inspect(data: bytes, requested: int, spare: int, bits: int) -> tuple[npt.NDArray[np.uint16], Blemish, BlockDefects]:
    """Return the words of a block, right-aligned, its blemishes and the counted defects.

    Trailing words with every bit set were not sent by the chip and are cut off. Single damaged words, known by their
    spare bits, become the mean of their neighbours.

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
    damaged = np.flatnonzero(raw & np.uint16(spare))
    top = (1 << bits) - 1
    words = raw & np.uint16(top)
    single = _are_single(damaged, raw.size)
    if single:
        words = _replaced(words, damaged)
        blemish |= Blemish.REPAIRED
    lost = _lost_bits(raw)
    misaligned = lost or (0 if single else damaged.size)
    defects = replace(
        _count(words, top, floated),
        misaligned=misaligned / raw.size,
        lost_bits=bool(lost),
        repaired=damaged.size if single else 0,
    )
    if defects.clipped and not floated:
        blemish |= Blemish.CLIPPED
    if misaligned:
        blemish |= Blemish.MISALIGNED
    if defects.stuck:
        blemish |= Blemish.STUCK
    return words, blemish, defects


def _are_single(damaged: npt.NDArray[np.intp], size: int) -> bool:
    """Whether there are damaged words, few and far from each other."""
    return 0 < damaged.size <= SINGLE_SHARE * size and bool((np.diff(damaged) > APART).all())


def _replaced(words: npt.NDArray[np.uint16], damaged: npt.NDArray[np.intp]) -> npt.NDArray[np.uint16]:
    """The words with the damaged ones interpolated; at an end, the neighbour's value."""
    good = np.delete(np.arange(words.size), damaged)
    words[damaged] = np.rint(np.interp(damaged, good, words[good])).astype(np.uint16)
    return words


def _lost_bits(raw: npt.NDArray[np.uint16]) -> int:
    """Number of words up to the end whose lowest bit is always 0: clocks have been lost before them.

    Lost clocks shift all later words up. Where these are small, no spare bit shows it; but zeros of the spare bits of
    the next word move into the lowest bits. The last word ends with released bits.
    """
    odd = np.flatnonzero(raw[:-1] & 1)
    run = raw[odd[-1] + 1 if odd.size else 0 : -1]
    changes = int(np.count_nonzero(run[1:] != run[:-1]))
    return run.size if changes >= EVEN_CHANGES and np.unique(run).size >= EVEN_VALUES else 0


def _released_at_end(raw: npt.NDArray[np.uint16]) -> int:
    alive = np.flatnonzero(raw != RELEASED)
    return raw.size - 1 - int(alive[-1]) if alive.size else raw.size


def _count(words: npt.NDArray[np.uint16], top: int, floated: bool) -> BlockDefects:
    margin = (top + 1) >> RAIL_BITS
    at_rail = (words <= margin) | (words >= top - margin)
    starts = np.concatenate(([0], np.flatnonzero(words[1:] != words[:-1]) + 1))
    lengths = np.diff(starts, append=words.size)
    longest = int(lengths[~at_rail[starts]].max(initial=0))
    return BlockDefects(
        clipped=float(np.count_nonzero(at_rail)) / words.size,
        stuck=longest >= min(STUCK_RUN, max(words.size, 2)),
        constant=starts.size == 1 < words.size,
        quiet=not at_rail.any() and float(np.std(words)) < QUIET_WORDS,
        floated=floated,
    )
