"""Air interface profiles and receiver front end, shared by transmitter and decoder (docs/air-interface.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class FrontEnd:
    """Analogue front end between the light and the ADC words.

    Attributes:
        full_scale_a: photocurrent from word 0 to word 2**bits; the coupling is AC, zero current reads half scale.
        lpf_hz: corner of the second-order Butterworth low-pass. hpf_hz: corner of the first-order AC coupling.
        led_tau_s: time constant of the lamps' rise, one value for all.
    """

    full_scale_a: float = 50e-6
    bits: int = 12
    lpf_hz: float = 8000.0
    hpf_hz: float = 50.0
    led_tau_s: float = 1.5e-6

    @property
    def lsb_a(self) -> float:
        """Photocurrent per ADC step, A."""
        return self.full_scale_a / 2.0**self.bits


@dataclass(frozen=True, slots=True)
class Profile:
    """One air interface with its receiver.

    Attributes:
        degree: of the Gold codes, ``2**degree - 1`` chips long. chip_rate: Manchester-coded chips per second.
        depth: modulation depth of the lamps (amplitude of the modulated part over the mean).
        sample_rate: nominal ADC rate, samples per second. epoch_s: nominal length of a block, s.
        clock_ppm: largest error of the sample clock. crystal_ppm: largest error of a lamp's crystal.
        mains_harmonics: multiples of the mains flicker that are modelled.
    """

    name: str
    degree: int
    chip_rate: float
    depth: float
    sample_rate: float
    epoch_s: float
    front_end: FrontEnd
    clock_ppm: float = 10_000.0
    crystal_ppm: float = 50.0
    mains_harmonics: int = 10

    @property
    def length(self) -> int:
        """Chips per code period."""
        return (1 << self.degree) - 1

    @property
    def period_s(self) -> float:
        """Seconds per code period, which is one data bit."""
        return self.length / self.chip_rate

    @property
    def samples_per_chip(self) -> float:
        """Nominal samples per chip, without clock errors."""
        return self.sample_rate / self.chip_rate


PROFILE_A: Final = Profile("A", 7, 5000.0, 0.30, 400e3 / 18, 0.05, FrontEnd())
"""Gold-127 at 5 kchip/s, read by an MCP3221-class converter at 400 kHz: the standard."""

PROFILE_B: Final = Profile("B", 6, 825.0, 0.10, 3300.0, 0.1, FrontEnd(lpf_hz=1320.0, hpf_hz=8.0, led_tau_s=1.5e-6))
"""Gold-63 at 825 chip/s for a 3.3 ksps converter."""

PROFILE_D: Final = Profile("D", 9, 20_000.0, 0.30, 94_400.0, 0.05, FrontEnd(lpf_hz=32_000.0, hpf_hz=200.0))
"""Gold-511 at 20 kchip/s for a 94 ksps converter."""

PROFILES: Final = {profile.name: profile for profile in (PROFILE_A, PROFILE_B, PROFILE_D)}
