"""Colour of the residual: noise of a converter is white, light that is not explained is not.

The codes, and whatever passes the low-pass, correlate from sample to sample.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.numerics.arrays import Array

LAGS: Final = (1, 2, 3)
"""Samples: up to a chip, whose halves have opposite signs."""

EVERY: Final = 4
"""Blocks between two looks."""

MEMORY: Final = 0.875
"""Weight of the earlier looks."""

SIGMAS: Final = 3.0
"""Correlation from which a residual is coloured, in sigmas of white noise."""


class Colour:
    """Averaged autocorrelation of the residuals of a decoder."""

    def __init__(self) -> None:
        """White."""
        self._wait = EVERY
        self._mean = [0.0] * len(LAGS)
        self.coloured = False

    def learn(self, residual: Array) -> None:
        """Average the residual (N,) of one block of a few."""
        self._wait -= 1
        if self._wait:
            return
        self._wait = EVERY
        energy = max(float(np.vdot(residual, residual)), 1e-12)
        seen = [float(np.vdot(residual[lag:], residual[:-lag])) / energy for lag in LAGS]
        self._mean = [MEMORY * mean + (1.0 - MEMORY) * now for mean, now in zip(self._mean, seen, strict=True)]
        variance = (1.0 - MEMORY) / (1.0 + MEMORY) / len(residual)
        self.coloured = max(mean * mean for mean in self._mean) > SIGMAS**2 * variance
