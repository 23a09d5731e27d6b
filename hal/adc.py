"""What a photodiode's converter yields, in device units: the contract between any ADC driver and the daemon."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Flag, auto
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.lidar import Link


class Blemish(Flag):
    """What is known to be wrong with a block of samples; the block is delivered all the same."""

    NONE = 0
    STRETCHED = auto()  # took longer than its bits: returned late, or samples inside are not evenly spaced
    CLIPPED = auto()  # words at either rail, or as close to one as an amplifier gets
    STUCK = auto()  # the same word over and over
    MISALIGNED = auto()  # upper bits set: shifted or lost bits, or a bus that floats
    SHORT = auto()  # fewer words than asked for
    GAP = auto()  # blocks are missing before this one: dropped, or the bus was not read for longer than a block


@dataclass(frozen=True, slots=True, eq=False)
class RawSamples:
    """One uniform block of conversions from one bus transaction. Blocks are never concatenated.

    Attributes:
        seq: counts blocks of this driver from 0.
        t0, t1: ``t_mono`` immediately before and after the transaction.
        t_first: earliest ``t_mono`` of the first conversion, anchored at ``t0``. slack_s: it was no later than
            ``t_first + slack_s``: by how much longer than its bits the transaction took. Nearly all of that is at the
            end, where ``t_first`` does not suffer from it (a late return: this process or its interpreter was busy);
            the rest is fixed overhead, another client of the bus before the block, or a stall inside it.
        rate_hz: conversions per second as measured from transaction lengths; the decoder refines it.
        words: uint16, right-aligned converter codes, 0 .. 2**bits - 1.
    """

    seq: int
    t0: float
    t1: float
    t_first: float
    rate_hz: float
    words: npt.NDArray[np.uint16]
    bits: int
    blemish: Blemish
    slack_s: float = 0.0


class ChipMissing(DeviceMissing):
    """The bus is there, and nothing acknowledges the converter's address."""


class WrongChip(DeviceRefused):
    """Something answers that is not such a converter."""


class BusStuck(DeviceFault):
    """Transactions time out, or do not return at all."""


class NoSignal(DeviceFault):
    """The words say nothing: no light, so much that the amplifier is saturated, or a dead converter."""


class Dark(NoSignal):
    """No light, as the DC channel says."""


class Dazzled(NoSignal):
    """Too much light, as the DC channel says."""


class Clipping(DeviceFault):
    """Much of the signal lies beyond the converter's range."""


@dataclass(slots=True)
class AdcStatus:
    """Live state and counters of a converter, read by the daemon for health."""

    link: Link = Link.CLOSED
    error: HalError | None = None
    blocks: int = 0
    blemished: int = 0
    dropped: int = 0
    recoveries: int = 0
    extra: dict[str, str] = field(default_factory=dict)


class Adc(Protocol):
    """A converter's driver. It supervises itself: `run` never raises for anything a bus or a chip can do."""

    @property
    def status(self) -> AdcStatus:
        """Live state and counters."""
        ...

    async def run(self, on_samples: Callable[[RawSamples], None]) -> None:
        """Read block after block; deliver from the loop thread; recover by itself until cancelled or exhausted."""
        ...
