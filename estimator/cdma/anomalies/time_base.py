"""Uneven time base: pauses of the bus that come at the same samples of every block, as of adapters that read in parts.

A pause moves all lamps at once. The joint fit leaves its time shift times the slope of the signal, in every block at
the same samples; lamps themselves have no relation to the begin of a block.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.numerics.arrays import Array

BIN: Final = 6
"""Samples whose time shift is estimated together."""

BLOCKS: Final = 8
"""Blocks that are averaged."""

EVIDENT: Final = 3.0
"""Mean square of the median shifts, in their sigmas, from which the pattern is believed; 1 by chance."""

SUSPECT: Final = 2.0
"""The same, below which there is no sign of a pattern, and one block in `EVEN_EVERY` is averaged."""
EVEN_EVERY: Final = 16

MEDIAN: Final = 1.57
"""Variance of a median over that of a mean."""

TYPICAL: Final = 0.32
"""Median of the squares of `BLOCKS` normal deviations from their median."""

REPEATED: Final = 3
"""Single pauses at one place, in blocks one after another, that count as a pattern."""

SAME_PLACE: Final = 24
"""Samples within which two pauses are at one place."""

LATE, UNKNOWN = 8, 20
"""Blocks in a row that took too long, by their time stamps, until the bus is taken to pause, and until all amplitudes
are uncertain if it is not known where.
"""

HELD: Final = 200
"""Blocks for which the time base counts as uneven after its last sign: the sample clock may take up the pauses."""

DOUBT, MOST_DOUBT = 4.0, 0.5
"""Relative error of amplitudes per chip of time shift that has just been learned, and at most."""

LARGEST: Final = 0.15
"""Largest correction at once, chips."""

SMALLEST: Final = 0.002
"""Chips, rms, below which a pattern is none."""


class TimeBase:
    """Learned time shift of each sample of a block, chips.

    Attributes:
        doubt: relative sigma of all amplitudes while the pattern still changes.
    """

    def __init__(self) -> None:
        """Samples are evenly spaced."""
        self._shift: Array = np.zeros(0)
        self._seen: list[tuple[Array, Array]] = []
        self._pauses: list[tuple[int, int, float]] = []  # block, sample, length
        self._late = self._unlearned = self._held = self._blocks = 0
        self.doubt = 0.0
        self._even = self._known = False

    @property
    def uneven(self) -> bool:
        """Whether there is a pattern of pauses, or was one in the last blocks."""
        return self._held > 0

    @property
    def unknown(self) -> bool:
        """Whether there are pauses at unknown places."""
        return self._late >= UNKNOWN and not self._known

    @property
    def contradicted(self) -> bool:
        """Whether time stamps have contradicted the sample clock long enough to look for another one."""
        return self._late > 0 and self._late % LATE == 0

    def forget(self) -> None:
        """Forget the pattern: it belongs to another sample clock."""
        self._shift, self._known = np.zeros(len(self._shift)), False
        self._seen, self._pauses = [], []

    def moved(self, x: Array) -> Array:
        """Sample times (N,) in chips with the pattern of pauses; unchanged for blocks of another length."""
        return x + self._shift if self._known and len(self._shift) == len(x) else x

    def on_stamps(self, late: bool) -> None:
        """Count a block; ``late``: its time stamps are farther apart than its samples account for."""
        self._blocks += 1
        self._late = self._late + 1 if late else 0
        self._held = HELD if self._known or self._late >= LATE else max(self._held - 1, 0)

    def on_pause(self, at: int, chips: float) -> None:
        """Count a single pause that has been found before sample ``at``, as long as ``chips``."""
        if self._pauses:
            block, place, _ = self._pauses[-1]
            if block < self._blocks - 1 or abs(place - at) > SAME_PLACE:
                self._pauses = []
        self._pauses.append((self._blocks, at, chips))
        if len(self._pauses) < REPEATED:
            return
        _, places, lengths = zip(*self._pauses, strict=True)
        step = np.zeros(len(self._shift))
        step[int(np.median(places)) :] = float(np.median(lengths))
        self._add(step)

    def learn(self, slope: Array, residual: Array, noise_var: float) -> None:
        """Average one more block: derivative of its signal by time (per chip), residual, noise variance per sample."""
        if len(self._shift) != len(residual):
            self._shift, self._seen, self._pauses, self._known = np.zeros(len(residual)), [], [], False
        self._unlearned += 1
        if self._even and not self._known and self._unlearned < EVEN_EVERY:
            return
        self._unlearned = 0
        edges = np.arange(0, len(residual), BIN)
        energy = np.maximum(np.add.reduceat(slope * slope, edges), 1e-12)
        self._seen.append((np.add.reduceat(slope * residual, edges) / energy, noise_var / energy))
        if len(self._seen) < BLOCKS:
            return
        shifts, variances = (np.array(rows) for rows in zip(*self._seen, strict=True))
        self._seen = []
        median, variance = np.median(shifts, axis=0), MEDIAN * np.median(variances, axis=0) / BLOCKS
        scatter = np.median((shifts - median) ** 2 / variances)  # a residual that is not noise varies more
        variance *= max(1.0, float(scatter) / TYPICAL)
        excess = float(np.mean(median**2 / variance))
        self._even, self.doubt = excess < SUSPECT, 0.0
        if excess > EVIDENT:
            median = median * np.maximum(1.0 - variance / np.maximum(median**2, 1e-18), 0.0)
            self._add(np.repeat(np.clip(median, -LARGEST, LARGEST), np.diff(np.append(edges, len(residual)))))

    def _add(self, shift: Array) -> None:
        """Correct the pattern, but not by a mean or a drift, which the clocks follow."""
        ramp = np.linspace(-1.0, 1.0, len(shift))
        shift = shift - shift.mean() - ramp * float((ramp * shift).sum() / (ramp * ramp).sum())
        self._shift = self._shift + shift
        self._known = float(np.sqrt(np.mean(self._shift**2))) > SMALLEST
        self.doubt = min(DOUBT * float(np.sqrt(np.mean(shift**2))), MOST_DOUBT)
        self._seen, self._pauses = [], []
