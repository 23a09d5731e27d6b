"""Colour of the residual: whether it contains chips.

Both halves of a chip cancel. So samples half a chip apart are alike less than those nearer and farther; noise of a
converter correlates nowhere, slow light everywhere.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.numerics.arrays import Array

LAGS: Final = ((1, 0.5), (2, -0.5), (3, -0.5), (4, 0.5))
"""Samples up to a chip, and the sign with which their correlation counts; the squares add to 1."""

EVERY: Final = 4
"""Blocks between two looks."""

MEMORY: Final = 0.875
"""Weight of the earlier looks."""

SIGMAS: Final = 3.0
"""Sigmas of white noise from which a residual is coloured."""


class Colour:
    """Averaged contrast of the autocorrelation of a decoder's residuals."""

    def __init__(self) -> None:
        """White."""
        self._wait = EVERY
        self._mean = 0.0
        self.coloured = False

    def learn(self, residual: Array) -> None:
        """Average the residual (N,) of one block of a few."""
        self._wait -= 1
        if self._wait:
            return
        self._wait = EVERY
        energy = max(float(np.vdot(residual, residual)), 1e-12)
        seen = sum(sign * float(np.vdot(residual[lag:], residual[:-lag])) for lag, sign in LAGS) / energy
        self._mean = MEMORY * self._mean + (1.0 - MEMORY) * seen
        self.coloured = self._mean > SIGMAS * np.sqrt((1.0 - MEMORY) / (1.0 + MEMORY) / len(residual))
