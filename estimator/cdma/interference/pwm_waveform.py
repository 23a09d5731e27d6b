"""Waveform of a PWM-dimmed lamp behind the receiver: a train of rising and one of falling edges, and its harmonics.

The response of the chain to an endless train of steps has a closed form, so that aliases of every order are included.
Times are in samples, frequencies in cycles per sample, edge phases in cycles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import Profile
from estimator.cdma.chip_pulse import step_modes
from estimator.cdma.correlation_kernels import gram, inner, mixed, tones
from estimator.cdma.interference.pwm_kernels import TRAIN_ROWS, trains, triangular
from estimator.numerics.arrays import Array

Complex = npt.NDArray[np.complex128]

HARMONICS: Final = 8
"""Harmonics with free amplitude and phase: for lamps whose light is no sharp rectangle, and above half the rate."""


@dataclass(frozen=True)
class Pulses:
    """One lamp's light in a block: frequency, and the phases of rising and falling edge at the middle of the block."""

    frequency: float
    rise: float
    fall: float

    @property
    def duty(self) -> float:
        """Duty cycle."""
        return (self.rise - self.fall) % 1.0


class Chain:
    """Step response of the receiver in samples: the sum of ``residues * exp(rates * t)``."""

    def __init__(self, profile: Profile) -> None:
        """Front end of the profile at its nominal sample rate."""
        rates, residues = step_modes(profile)
        self._rates: Complex = rates * profile.chip_rate / profile.sample_rate
        self._residues: Complex = residues
        kept = self._rates.imag >= 0.0  # the others are conjugates
        twice = np.where(self._rates.imag > 0.0, 2.0, 1.0) * residues
        self._modes = np.array([self._rates.real, self._rates.imag, twice.real, twice.imag])[:, kept].copy()

    def gain(self, frequency: Array) -> Complex:
        """Complex gain for sinusoids."""
        s = 2j * np.pi * frequency[:, None]
        gain: Complex = (self._residues * s / (s - self._rates)).sum(axis=1)
        return gain

    def trains(self, pulses: Pulses, times: Array) -> Array:
        """(8, N) edge trains, see :data:`estimator.cdma.interference.pwm_kernels.TRAIN_ROWS`."""
        out = np.empty((TRAIN_ROWS, len(times)))
        trains(self._modes, np.array((pulses.frequency, pulses.rise, pulses.fall)), times, out)
        return out

    def rows(self, pulses: Pulses, times: Array) -> Array:
        """(8 + 2 * `HARMONICS`, N) rows that span the light of the lamp."""
        out = np.empty((TRAIN_ROWS + 2 * HARMONICS, len(times)))
        out[:TRAIN_ROWS] = self.trains(pulses, times)
        tones(pulses.frequency, times, out[TRAIN_ROWS:])
        return out


def without(rows: Array, known: Array) -> Array:
    """Rows without the span of the orthonormal rows ``known``, in place."""
    for row in rows:
        row -= mixed(inner(known, row), known)
    return rows


def orthonormal(rows: Array, known: Array) -> Array:
    """Orthonormal rows (count, N) of the same span beyond that of the orthonormal rows ``known``; overwrites rows."""
    rows *= (1.0 / np.sqrt(np.maximum(np.einsum("ij,ij->i", rows, rows), 1e-24)))[:, None]
    products = np.empty((len(rows), len(rows)))
    gram(without(rows, known), len(rows), products)
    weights = np.empty_like(products)
    count = triangular(products, weights)
    out = np.empty((count, rows.shape[1]))
    for row, weight in zip(out, weights, strict=False):
        row[:] = mixed(weight, rows)
    return out
