"""The contract between the photodiode's ADC driver and the daemon: sample blocks in device units, status, errors."""

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
    """Known defects of a sample block. The block is delivered nevertheless."""

    NONE = 0
    STRETCHED = auto()  # longer than its bits take: returned late, or its samples are not evenly spaced
    CLIPPED = auto()  # words at either rail, or as close to it as the amplifier gets
    STUCK = auto()  # the same word over and over
    MISALIGNED = auto()  # upper bits set, or lowest bits always 0: shifted or lost bits, or a floating bus
    SHORT = auto()  # fewer words than requested
    GAP = auto()  # blocks are missing before this one: dropped, or the bus was not read for longer than a block
    REPAIRED = auto()  # single words had upper bits set; each was replaced by the mean of its neighbours


@dataclass(frozen=True, slots=True, eq=False)
class RawSamples:
    """One uniform block of conversions from one bus transaction. Blocks are never concatenated.

    Attributes:
        seq: counts blocks of this driver from 0.
        t0, t1: ``t_mono`` immediately before and after the transaction.
        t_first: earliest ``t_mono`` of the first conversion, anchored at ``t0``.
        slack_s: upper bound of the delay of the first conversion after ``t_first``: the transaction's excess over the
            duration of its bits. Most of the excess is a late return at the end (the process or its interpreter was
            busy) and does not move ``t_first``. The rest is fixed overhead, another client of the bus before the
            block, or a stall inside it.
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
    """The bus is present, but nothing acknowledges the converter's address."""


class WrongChip(DeviceRefused):
    """Another kind of chip answers at the converter's address."""


class BusStuck(DeviceFault):
    """Transactions time out, or do not return."""


class NoSignal(DeviceFault):
    """The words carry no signal: no light, a saturated amplifier, or a dead converter."""


class Dark(NoSignal):
    """No light, according to the DC channel."""


class Dazzled(NoSignal):
    """A saturated amplifier, according to the DC channel."""


class Clipping(DeviceFault):
    """A large part of the signal lies beyond the converter's range."""


@dataclass(slots=True)
class AdcStatus:
    """Live state and counters of a converter; the daemon reads them for health."""

    link: Link = Link.CLOSED
    error: HalError | None = None
    blocks: int = 0
    blemished: int = 0
    dropped: int = 0
    recoveries: int = 0
    extra: dict[str, str] = field(default_factory=dict)


class Adc(Protocol):
    """A converter's driver. It supervises itself: `run` raises for no failure of a bus or a chip."""

    @property
    def status(self) -> AdcStatus:
        """Live state and counters."""
        ...

    async def run(self, on_samples: Callable[[RawSamples], None]) -> None:
        """Read blocks, deliver them from the loop thread, and recover from failures, until cancelled or exhausted."""
        ...
