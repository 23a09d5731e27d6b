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
from estimator.cdma.correlation_kernels import combine, gram, inner, invert, mixed, tones
from estimator.cdma.interference.pwm_kernels import TRAIN_ROWS, trains, triangular
from estimator.numerics.arrays import Array

Complex = npt.NDArray[np.complex128]

HARMONICS: Final = 8
"""Harmonics with free amplitude and phase: for lamps whose light is no sharp rectangle, and above half the rate."""

ROUNDED: Final = 1e-8
"""Share of a row's energy beyond others that may be rounding."""


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


def least_squares(rows: Array, known: Array, row: Array) -> tuple[Array, float]:
    """Weights of a few rows beside the orthonormal rows ``known``, and the energy that they explain.

    ``row`` contains nothing of ``known``.
    """
    products, right, inside = np.empty((len(rows), len(rows))), inner(rows, row), np.empty((len(rows), len(known)))
    gram(rows, len(rows), products)
    for part, one in zip(inside, rows, strict=True):
        part[:] = inner(known, one)
    products -= np.einsum("ik,jk->ij", inside, inside)
    products[np.diag_indices(len(rows))] *= 1.0 + 1e-9
    products[np.diag_indices(len(rows))] += 1e-12
    invert(products)
    weights: Array = (products * right).sum(axis=1)
    return weights, float((weights * right).sum())


def _beyond(rows: Array, known: Array) -> tuple[Array, Array]:
    """Rows and ``known`` in one stack, and weights that make of it orthonormal rows beyond ``known``."""
    stack, n = np.concatenate((rows, known)), len(rows)
    products = np.empty((len(stack), n))
    gram(stack, n, products)
    inside = products[n:]
    own = products[:n] - np.einsum("ki,kj->ij", inside, inside)
    left = own.diagonal()  # each row's energy beyond `known`: that of an edge train is mostly its mean
    scale = np.where(left > ROUNDED * products[:n].diagonal(), 1.0 / np.sqrt(np.maximum(left, 1e-30)), 0.0)
    own *= scale * scale[:, None]
    weights = np.empty_like(own)
    weights = weights[: triangular(own, weights)] * scale
    return stack, np.concatenate((weights, -np.einsum("ci,ki->ck", weights, inside)), axis=1)


def orthonormal(rows: Array, known: Array) -> Array:
    """Orthonormal rows (count, N) of the span of ``rows`` beyond that of the orthonormal rows ``known``."""
    stack, weights = _beyond(rows, known)
    out = np.empty((len(weights), rows.shape[1]))
    combine(weights, stack, out)
    return out


def explained(rows: Array, known: Array, row: Array) -> tuple[Array, float, int]:
    """Part (N,) of a row that lies in the span of ``rows`` beyond ``known``, its energy, and the rank of that span."""
    stack, weights = _beyond(rows, known)
    found = inner(weights, inner(stack, row))
    return mixed((found[:, None] * weights).sum(axis=0), stack), float((found * found).sum()), len(weights)
