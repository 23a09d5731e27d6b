"""Photodiode converter: creates its driver from the configuration, and detects missing sample blocks."""

from __future__ import annotations

from typing import Final, Protocol

from daemon.config.schema import PhotodiodeConfig, parse_chip
from estimator import PROFILES, Profile
from hal.adc import Adc, AdcStatus, RawSamples
from hal.bus.i2c import BusOpener
from hal.clock import Clock

SILENT_BLOCKS: Final = 3.0
"""Number of block periods without a block after which the converter has timed out; the cycle shows it within two more.
The period is never below the configured one: an adapter with short blocks delivers many at a time."""


class AdcMaker(Protocol):
    """Factory of a converter's driver from its configuration."""

    def __call__(self, config: PhotodiodeConfig, clock: Clock, opener: BusOpener) -> Adc:
        """Return a driver that is not running yet."""
        ...


def make_adc(config: PhotodiodeConfig, clock: Clock, opener: BusOpener) -> Adc:
    """Driver of the configured converter, with the block length of the air interface."""
    from hal.photodiode.dc_channel import LevelInput
    from hal.photodiode.driver import PhotodiodeAdc, Sampling

    chip, address, _ = parse_chip(config.converter)
    level = None
    if config.level:
        name, where, channel = parse_chip(config.level)
        level = LevelInput(name, where, channel or 0)
    sampling = Sampling(profile_of(config).epoch_s, level)
    return PhotodiodeAdc(config.bus, address, chip, clock=clock, opener=opener, sampling=sampling)


def profile_of(config: PhotodiodeConfig) -> Profile:
    """Air interface profile of the configuration."""
    return PROFILES[config.profile]


class BlockWatch:
    """Arrival monitor of sample blocks.

    Attributes:
        status: of the driver, live. seconds: length of a block.
    """

    def __init__(self, status: AdcStatus, profile: Profile) -> None:
        self.status = status
        self.seconds = self._asked_s = profile.epoch_s
        self._latest: float | None = None

    def on_block(self, block: RawSamples) -> None:
        """Register a usable block."""
        self.seconds = block.words.size / block.rate_hz
        self._latest = block.t1

    def ok(self, t_mono: float) -> bool:
        """Whether blocks are arriving."""
        return self._latest is not None and t_mono - self._latest <= SILENT_BLOCKS * max(self.seconds, self._asked_s)
