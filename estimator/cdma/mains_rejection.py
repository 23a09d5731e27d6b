"""Mains rejection: projects offset, slow drift and mains lamp flicker out of a block, and tracks the flicker frequency.

The subspace: constant, ramp, parabola, harmonics of the flicker, and the fundamental times t. The last one covers a
fundamental of slightly other frequency or changing strength. The frequency is tracked in cycles per sample, so that it
includes the error of the sample clock.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.cdma.correlation_kernels import combine, gram, inner, invert, tones
from estimator.numerics.arrays import Array

FUNDAMENTALS_HZ: Final = (100.0, 120.0)
PULL: Final = 0.03
"""Largest relative deviation of a tracked frequency from its nominal value (sample clock and grid together)."""

REBUILD: Final = 3e-5
"""Relative frequency step that justifies a new basis: 0.003 Hz, 0.001 rad of the second harmonic at a block's ends."""

GAIN: Final = 0.25
"""Share of the frequency error of one block that is corrected. Chance then seldom reaches `REBUILD`, and a grid that
changes by 0.01 Hz/s is followed to 0.002 Hz.
"""

JUMP: Final = 5e-4
"""Limit of the relative frequency error of one block: a larger one is a disturbance, not the grid."""

INSISTENT: Final = 3
"""Blocks in a row with larger errors of one sign: the frequency has been chosen from a disturbed or a dark block."""

FLICKER: Final = 25.0
"""Energy of the fundamental over that of as much noise, from which there is flicker to track."""

RIDGE: Final = 1e-9
"""Relative and absolute regularisation of rows that masked samples make alike."""

_COS, _SIN, _T_COS, _T_SIN = 3, 4, 5, 6


def basis(times: Array, frequency: float, harmonics: int) -> Array:
    """Rows to be projected out, (5 + 2 * harmonics, N), not orthogonal; ``frequency`` in cycles per unit of time."""
    middle = 0.5 * (times[0] + times[-1])
    t = 2.0 * (times - middle) / (times[-1] - times[0])
    multiples, rows = np.empty((2 * harmonics, len(t))), np.empty((5 + 2 * harmonics, len(t)))
    tones(frequency, times - middle, multiples)
    rows[0], rows[1], rows[2] = 1.0, t, t * t
    rows[_COS], rows[_SIN] = multiples[0], multiples[harmonics]
    rows[_T_COS], rows[_T_SIN] = t * rows[_COS], t * rows[_SIN]
    rows[7 : 6 + harmonics], rows[6 + harmonics :] = multiples[1:harmonics], multiples[harmonics + 1 :]
    return rows


def orthonormal(rows: Array) -> tuple[Array, Array]:
    """Orthonormal rows q of the same span, and the lower matrix with ``q = lower @ rows`` (Cholesky of the Gram)."""
    products = np.empty((len(rows), len(rows)))
    gram(rows, len(rows), products)
    lower = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(products)))
    out = np.empty_like(rows)
    combine(lower, rows, out)
    return out, lower


def _power(c: list[float]) -> float:
    """Power of the fundamental, by the coefficients of the basis."""
    return c[_COS] ** 2 + c[_SIN] ** 2 + c[_T_COS] ** 2 + c[_T_SIN] ** 2


class Mains:
    """Frequency tracker of the flicker, with the orthonormal basis for blocks of one size."""

    def __init__(self, sample_rate: float, harmonics: int) -> None:
        """``sample_rate``: nominal, samples per second; ``harmonics``: multiples of the flicker that are modelled."""
        self._rate = sample_rate
        self._harmonics = harmonics
        self._frequency = 0.0
        self._nominal = 0.0
        self._beyond = 0  # blocks in a row with errors beyond `JUMP`, with their sign
        self._built = (0, 0.0)
        self._q: Array = np.empty((0, 0))
        self._upper: Array = np.empty((0, 0))

    @property
    def hertz(self) -> float:
        """Fundamental of the flicker (Hz) by the nominal sample clock; 0 before the first block."""
        return self._frequency * self._rate

    def rows(self, y: Array) -> Array:
        """Orthonormal rows (M, N) for a block; the first block decides between 50 and 60 Hz grids."""
        if not self._frequency:
            self._choose(y)
        return self._fresh(len(y))

    def learn(self, y: Array) -> None:
        """Track the flicker of an undisturbed block, for the next one."""
        inside = inner(self.rows(y), y)
        rest = float(np.vdot(y, y) - np.vdot(inside, inside))
        self._follow(inner(self._upper, inside).tolist(), self._built[1], rest, len(y))

    def learn_masked(self, y: Array, mask: Array, more: Array) -> None:
        """The same for a block with masked samples; ``more``: (M, N) rows of other light in it."""
        own = self.basis(np.arange(len(y), dtype=np.float64))
        rows = np.concatenate((own * mask, more))
        products = np.empty((len(rows), len(rows)))
        gram(rows, len(rows), products)
        products[np.diag_indices(len(rows))] *= 1.0 + RIDGE
        products[np.diag_indices(len(rows))] += RIDGE
        invert(products)
        right = inner(rows, y)
        coefficients = inner(products, right)
        rest = float(np.vdot(y, y) - np.vdot(coefficients, right))
        self._follow(coefficients.tolist(), self._frequency, rest, len(y))

    def masked(self, times: Array, mask: Array) -> Array:
        """Orthonormal rows for a block with masked samples or a corrected time base; ``times`` in samples."""
        return orthonormal(self.basis(times) * mask)[0]

    def basis(self, times: Array) -> Array:
        """Rows of the subspace (M, N), not orthogonal; ``times`` in samples."""
        return basis(times, self._frequency, self._harmonics)

    def _fresh(self, size: int) -> Array:
        """Basis for blocks of this size, recomputed if size or frequency changed."""
        moved = abs(self._frequency - self._built[1]) > REBUILD * self._frequency
        if size != self._built[0] or moved:
            rows = basis(np.arange(size, dtype=float), self._frequency, self._harmonics)
            self._q, lower = orthonormal(rows)
            self._upper = np.ascontiguousarray(lower.T)
            self._built = (size, self._frequency)
        return self._q

    def _error(self, c: list[float], built: float, size: int) -> float:
        """Error of the frequency to first order: it looks like t times the quadrature of the sinusoid ``built``.

        ``c``: coefficients of the basis.
        """
        power = max(_power(c), 1e-30)
        beat = (c[_T_COS] * c[_SIN] - c[_T_SIN] * c[_COS]) / (np.pi * (size - 1) * power)
        return built + float(beat) - self._frequency

    def _follow(self, c: list[float], built: float, rest: float, size: int) -> None:
        """Correct the frequency by one block; ``rest``: energy of the block that the basis does not explain."""
        if 0.5 * size**2 * _power(c) < FLICKER * rest:
            return
        error, limit = self._error(c, built, size), JUMP * self._nominal
        sign = 1 if error > 0.0 else -1
        self._beyond = (self._beyond + sign if self._beyond * sign > 0 else sign) if abs(error) > limit else 0
        if abs(self._beyond) < INSISTENT:
            self._correct(GAIN * min(max(error, -limit), limit))
        elif not self._correct(error):
            self._frequency = 0.0  # the other grid: chosen anew from the next block

    def _correct(self, step: float) -> bool:
        """Change the frequency, within `PULL` of its nominal value; returns whether it stays within."""
        moved, reach = self._frequency + step, PULL * self._nominal
        self._frequency = min(max(moved, self._nominal - reach), self._nominal + reach)
        return self._frequency == moved

    def _choose(self, y: Array) -> None:
        """Choose 50 or 60 Hz grid, and its frequency to first order, from the first block."""
        tried = []
        for hertz in FUNDAMENTALS_HZ:
            self._frequency = self._nominal = hertz / self._rate
            for _ in range(3):
                inside = inner(self._fresh(len(y)), y)
                self._correct(self._error(inner(self._upper, inside).tolist(), self._built[1], len(y)))
            left = inner(self._fresh(len(y)), y)
            tried.append((float(y @ y - left @ left), self._frequency, self._nominal))
        _, self._frequency, self._nominal = min(tried)
