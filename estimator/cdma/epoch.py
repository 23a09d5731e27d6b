"""Input and output of the light decoder: sample block, and light epoch with its links and flags."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from estimator.cdma.data_frame import LampFrame
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]


class BlockFlag(IntFlag):
    """Defects of a block; several may be set."""

    NONE = 0
    CLIPPED = 1  # some samples at the rails; they were masked
    SATURATED = 2  # too many at the rails: no amplitudes
    FLAT = 4  # no variation at all: no light, or a dead converter
    MALFORMED = 8  # impossible words, rate or times
    LENGTH = 16  # shorter than a code period, or too long to process
    STALLED = 32  # a bus stall inside; amplitudes are not to be used
    MENDED = 64  # a bus stall inside, corrected, or a burst, left out
    NOISY = 128  # residual far above usual: part of the light is not explained
    OVERDRIVEN = 256  # the first stage was saturated for a part; these samples were masked
    UNEVEN = 512  # the bus pauses at the same samples of every block; corrected as far as known


UNUSABLE = BlockFlag.SATURATED | BlockFlag.FLAT | BlockFlag.MALFORMED | BlockFlag.LENGTH | BlockFlag.STALLED

USUAL = BlockFlag.CLIPPED | BlockFlag.OVERDRIVEN | BlockFlag.UNEVEN
"""Lasting conditions under which the joint fit explains a block."""


class LinkFlag(IntFlag):
    """Properties of one link."""

    NONE = 0
    FAINT = 1  # amplitude not significant (occluded, or out of view); the phase is kept
    TWIN = 2  # another lamp with the same code is in view: the ID alone is ambiguous
    SLOW = 4  # its light rises more slowly than the air interface allows: the amplitude is corrected


SLOW = int(LinkFlag.SLOW)
"""The flag as a number: enum operations on arrays are slow."""


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """One uninterrupted read of the converter.

    Attributes:
        t_begin, t_end: ``t_mono`` just before and just after the read. words: ADC words.
        rate: samples per second, nominal.
    """

    t_begin: float
    t_end: float
    words: Array
    rate: float


@dataclass(frozen=True, slots=True)
class PwmLight:
    """A PWM-dimmed lamp in view.

    Attributes:
        hertz: frequency. swing_a: photocurrent between off and on, A.
        other_hertz: a frequency that the samples cannot tell from it; None: the frequency is certain.
    """

    hertz: float
    swing_a: float
    other_hertz: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LightEpoch:
    """Lamps received over ``[t_begin, t_end]`` and their RSS; arrays have one element per link.

    Attributes:
        ids: code numbers; an ID may occur twice (see `LinkFlag.TWIN`).
        amplitude: RSS, A, amplitude of the modulated photocurrent. variance: A^2. flags: of :class:`LinkFlag`.
        lamps: data frame of each lamp, None until its first frame is complete.
        block: of :class:`BlockFlag`; without a usable block there are no links. noise_a: A per sample.
        clock_ppm: error of the sample clock, None until it is known. pwm: PWM-dimmed lamps, whose light is taken out.
        relative_var: part of the variances that comes from errors in proportion to the amplitude, over its square; such
            errors make no lamp doubtful. None: 0.
    """

    t_begin: float
    t_end: float
    ids: Index
    amplitude: Array
    variance: Array
    flags: Index
    lamps: tuple[LampFrame | None, ...]
    block: BlockFlag
    noise_a: float
    clock_ppm: float | None
    pwm: tuple[PwmLight, ...] = ()
    relative_var: Array | None = None

    @property
    def slow(self) -> frozenset[int]:
        """Codes of the lamps that rise too slowly."""
        return frozenset(self.ids[(self.flags & SLOW) != 0].tolist())
