"""True frequency and swing of a PWM-dimmed lamp from its harmonics: those above half the sample rate are folded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.interference.pwm_waveform import Chain, Complex
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

DUTIES: Final = np.arange(2, 99) * 0.01
"""Trial duty cycles."""

SCARCE: Final = 0.02
"""Cost of a duty cycle other than one half, as a share of the light: one line alone shows no duty cycle."""

LIKELIER: Final = 0.5
"""Misfit, as a share of that of another frequency, above which the lower of the two is believed."""

ALIKE: Final = 0.02
"""The same, above which the other frequency is named, too: duty cycle and form of the light are not known."""

HIGHEST_HZ: Final = 40e3
"""Highest frequency of dimmers that is considered."""

REPEATED: Final = 0.05
"""Relative amplitude below which a harmonic is absent."""


def distinct(frequency: float, count: int, cell: float) -> Index:
    """Harmonics, of the first ``count``, that are not folded onto another or their mirror image; and the first one."""
    cycles = frequency * np.arange(1, count + 1)
    lines = np.abs(cycles - np.round(cycles))
    shared = np.tril(np.abs(lines[:, None] - lines) < cell, -1).any(axis=1) | (np.abs(lines - 0.25) > 0.25 - 0.5 * cell)
    shared[0] = False
    return np.flatnonzero(~shared) + 1


def order(harmonics: Index, found: Complex) -> int:
    """Greatest common divisor of the harmonics that are present: above 1, the fundamental is that multiple."""
    return int(np.gcd.reduce(harmonics[np.abs(found) > REPEATED * np.abs(found).max()]))


@dataclass(frozen=True)
class Named:
    """Frequency (cycles per sample) of a lamp, its swing (ADC steps), and a frequency that looks alike, if any."""

    frequency: float
    swing: float
    other: float | None = None


def named(chain: Chain, frequency: float, k: Index, found: Complex, rate_hz: float, noise: float) -> Named:
    """Frequency and swing of the light that has these harmonics.

    Args:
        chain: receiver.
        frequency: apparent one, or any that is folded to it.
        k: harmonics, from the first one on.
        found: their complex amplitudes.
        rate_hz: samples per second.
        noise: variance of each amplitude.
    """
    highest = max(HIGHEST_HZ / rate_hz, frequency)
    trials = sorted(
        (misfit + 2.0 * noise * len(found), trial, swing)
        for cycles in range(int(highest) + 2)
        for sign, seen in ((1.0, found), (-1.0, np.conj(found)))
        if 0.0 < (trial := cycles + sign * frequency) <= highest
        for misfit, swing in (_misfit(chain, trial, k, seen),)
    )
    likely = [trial for trial in trials if trial[0] <= trials[0][0] / LIKELIER]
    first = min(likely, key=lambda trial: trial[1])
    alike = [trial for trial in trials if trial is not first and trial[0] <= trials[0][0] / ALIKE]
    return Named(first[1], first[2], alike[0][1] if alike else None)


def _misfit(chain: Chain, frequency: float, k: Index, found: Complex) -> tuple[float, float]:
    """Energy of harmonics ``k`` that a rectangle of this frequency leaves, at its best duty cycle, and its swing."""
    gain = chain.gain(frequency * k.astype(np.float64)) / (np.pi * k)
    model = -1j * gain * (1.0 - np.exp(-2j * np.pi * k * DUTIES[:, None]))
    turn = np.exp(1j * k * (np.angle(found[0]) - np.angle(model[:, :1])))
    model = model * turn
    energy = np.maximum((np.abs(model) ** 2).sum(axis=1), 1e-30)
    swing: Array = np.maximum((np.conj(model) * found).real.sum(axis=1) / energy, 0.0)
    left = (np.abs(found - swing[:, None] * model) ** 2).sum(axis=1)
    left = left + (SCARCE * np.abs(found[0]) * (DUTIES - 0.5)) ** 2
    at = int(np.argmin(left))
    return float(left[at]), float(swing[at])
