"""Data types of the block solvers: sampled block with mains basis, prior of the tracks, result of the fit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.cdma.correlation_kernels import inner, mixed
from estimator.numerics.arrays import Array


def rows_of(*rows: Array) -> Array:
    """Stack rows of one length into an array; `np.stack` takes four times as long."""
    out = np.empty((len(rows), len(rows[0])))
    for k, row in enumerate(rows):
        out[k] = row
    return out


@dataclass(eq=False)
class Sampled:
    """One block, ready to be solved.

    Attributes:
        y: (N,) photocurrent in ADC steps, 0 where masked. x: (N,) chips from the middle, by the clock's best estimate.
        mask: (N,) 1, or 0 for masked samples. q: (M, N) orthonormal rows of the mains subspace.
        steps: sample indices at which a bus stall ends; ``x`` already contains the initial length of each pause.
    """

    y: Array
    x: Array
    mask: Array
    q: Array
    steps: tuple[int, ...] = ()

    @cached_property
    def samples(self) -> Array:
        """(2, N) times and weights, in the layout of the kernels."""
        return rows_of(self.x, self.mask)

    @cached_property
    def clean(self) -> Array:
        """(N,) photocurrent without the mains subspace."""
        return self.project(self.y)

    def project(self, row: Array) -> Array:
        """Remove the mains subspace from a row (not by a matrix product, which would start BLAS threads)."""
        return row - mixed(inner(self.q, row), self.q)


@dataclass(eq=False)
class Prior:
    """Prediction of the tracks for the middle of the block; arrays (L,) except chips (L, C).

    Attributes:
        phase, rate: chips, and chips per nominal chip. phase_var: chips^2.
        lag_var, clock_var: of the common delay (chips^2) and of the relative sample clock.
        amplitude: ADC steps, of the last block; only ranks the lamps by strength.
        bit_sum, bit_weight: soft bit of the first code period touched, from the last block.
        pulse: number of each lamp's pulse table.
    """

    chips: Array
    phase: Array
    rate: Array
    phase_var: Array
    lag_var: float
    clock_var: float
    amplitude: Array
    bit_sum: Array
    bit_weight: Array
    pulse: Array

    def lamps(self, more: Array | float = 0.0) -> Array:
        """(3, L) phases, plus a correction ``more`` (chips), rates, and pulse tables, in the layout of the kernels."""
        return rows_of(self.phase + more, self.rate, self.pulse)


@dataclass(eq=False)
class Fit:
    """Result of the joint fit; arrays (L,) unless stated. Phases are corrections to the prior's, in chips.

    Attributes:
        amplitude, amplitude_var: ADC steps. phase, phase_var: of each lamp beyond the common delay.
        lag, lag_var, clock, clock_var: common delay and relative clock, corrections to the prior's.
        steps: length of each stall beyond that in ``x``, chips.
        residual: (N,) of the fit. noise_var: per sample.
        soft, soft_var: (L, P) amplitude times data sign of each code period touched; variance inf where not touched.
        signs: (L, P) data signs used, 0 where left out.
        mixed_slope: (N,) derivative of the whole signal by a common phase.
        nuisance: (N,) fitted mains and PWM light.
    """

    amplitude: Array
    amplitude_var: Array
    phase: Array
    phase_var: Array
    lag: float
    lag_var: float
    clock: float
    clock_var: float
    steps: Array
    residual: Array
    noise_var: float
    soft: Array
    soft_var: Array
    signs: Array
    mixed_slope: Array
    nuisance: Array

    @property
    def clearest(self) -> float:
        """Largest amplitude in standard deviations."""
        return float(np.max(self.amplitude / np.sqrt(self.amplitude_var)))
