"""Detection of the comb of spectral lines of a PWM-dimmed lamp in a residual, aliases included."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

SHARE: Final = 0.05
"""Share of the residual's energy in one line or comb, beyond chance, from which it is a lamp's. The strongest line of a
code has 0.022.
"""
CHANCE: Final = 0.012
"""Further share for each square root of the number of harmonics."""

PADDING: Final = 2
"""Spectral points per resolution cell, at least."""
LOWEST_CELLS: Final = 6.0
"""Lowest fundamental, in resolution cells: slower light belongs to the mains subspace."""
MOST_HARMONICS: Final = 60
LARGEST_ORDER: Final = 16
"""Largest harmonic that may be the strongest line."""
BETTER: Final = 1.25
"""Factor in explained energy by which a lower fundamental must exceed a higher one."""


def fundamental(residual: Array, usual: int = 0) -> float | None:
    """Fundamental (cycles per sample, below 0.5) of the strongest comb of lines in a block; None if there is none.

    ``usual``: samples of a usual block; longer ones do not resolve more from the mains.
    """
    n = len(residual)
    lowest = LOWEST_CELLS / (min(n, usual) or n)
    size = 1 << (PADDING * n - 1).bit_length()
    power = np.abs(np.fft.rfft(residual, size)) ** 2 * (2.0 / (n * max(float(np.vdot(residual, residual)), 1e-30)))
    first = int(lowest * size)
    peak = int(np.argmax(power[first:-1])) + first
    if power[peak] < 0.3 * SHARE:
        return None
    before, there, behind = power[peak - 1 : peak + 2].tolist()
    line = (peak + 0.5 * (behind - before) / max(2.0 * there - before - behind, 1e-30)) / size
    best, found = 0.0, None
    for order in range(1, LARGEST_ORDER + 1):
        frequency = line / order
        if frequency < lowest:
            break
        multiples = np.arange(1, min(MOST_HARMONICS, int(1.5 / frequency)) + 1, dtype=np.int64)
        excess = _comb_share(power, frequency, multiples, n, size) - 2.0 * len(multiples) / n
        if excess > SHARE + CHANCE * np.sqrt(len(multiples)) and excess > BETTER * best:
            best, found = excess, frequency
    return found


def _comb_share(power: Array, frequency: float, multiples: Index, n: int, size: int) -> float:
    """Share of the energy at these multiples, folded at half the rate; those within a resolution cell count once."""
    folded = np.sort(np.abs(frequency * multiples - np.round(frequency * multiples)))
    single = np.diff(folded, prepend=-1.0) > 1.5 / n
    return float(np.sum(power[np.round(folded[single] * size).astype(np.int64)]))
