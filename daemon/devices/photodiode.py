"""The photodiode's converter as the daemon sees it: made from the configuration, and watched for silence."""

from __future__ import annotations

from typing import Final, Protocol

from daemon.config.schema import PhotodiodeConfig, parse_chip
from estimator import PROFILES, Profile
from hal.adc import Adc, AdcStatus, RawSamples
from hal.bus.i2c import BusOpener
from hal.clock import Clock

SILENT_BLOCKS: Final = 3.0
"""Blocks that may fail to come before the converter is said to be silent; the cycle shows it within two more. None is
counted as shorter than it was asked for: an adapter that does only short ones hands them over many at a time."""


class AdcMaker(Protocol):
    """Makes a converter's driver from its configuration."""

    def __call__(self, config: PhotodiodeConfig, clock: Clock, opener: BusOpener) -> Adc:
        """A driver that is not running yet."""
        ...


def make_adc(config: PhotodiodeConfig, clock: Clock, opener: BusOpener) -> Adc:
    """The driver of the configured converter, in blocks of the length that the air interface is meant for."""
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
    """The configured air interface."""
    return PROFILES[config.profile]


class BlockWatch:
    """Knows when the latest block came, and how long blocks are.

    Attributes:
        status: of the driver, live. seconds: length of a block.
    """

    def __init__(self, status: AdcStatus, profile: Profile) -> None:
        self.status = status
        self.seconds = self._asked_s = profile.epoch_s
        self._latest: float | None = None

    def on_block(self, block: RawSamples) -> None:
        """A block that can be used was taken."""
        self.seconds = block.words.size / block.rate_hz
        self._latest = block.t1

    def ok(self, t_mono: float) -> bool:
        """Whether blocks are coming."""
        return self._latest is not None and t_mono - self._latest <= SILENT_BLOCKS * max(self.seconds, self._asked_s)
