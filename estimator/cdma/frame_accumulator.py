"""Soft data bits of the lamps that are followed, gathered over repetitions of their frames until they can be read."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.correlation_kernels import fold
from estimator.cdma.data_frame import FRAME_BITS, LampFrame, decode_ring
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

KNOWN: Final = 3.0
"""A bit counts as received when its sign is so many standard deviations clear; the CRC finds up to three wrong ones."""

FADE: Final = 0.7
"""Weight of what the repetition before said of the same bit: a lamp that is told something new is believed in 9 s."""

RETRY: Final = 29
"""New bits before another attempt at a frame that failed its check: a quarter of it."""


class BitRings:
    """Soft bits of all tracked lamps, folded on the frame's length, so that weak lamps gain by repetition."""

    def __init__(self, capacity: int) -> None:
        self._rings: Array = np.zeros((2, capacity, FRAME_BITS))  # sums and weights
        self._last: Index = np.full((capacity, FRAME_BITS), -1)
        self._due: Index = np.zeros(capacity, np.int64)

    @property
    def _sum(self) -> Array:
        view: Array = self._rings[0]  # no attribute: a view that is kept and pickled becomes an array of its own
        return view

    @property
    def _weight(self) -> Array:
        view: Array = self._rings[1]
        return view

    def forget(self, slot: int) -> None:
        """Start anew in a slot that another lamp takes."""
        self._sum[slot], self._weight[slot], self._last[slot], self._due[slot] = 0.0, 0.0, -1, 0

    def add(self, slots: Index, period: Index, soft: Array, variance: Array) -> None:
        """Take in what one block says.

        Args:
            slots: (L,).
            period: (L,) running number of the first code period touched, not folded.
            soft: (L, P) amplitude times sign of each period touched.
            variance: (L, P), inf where not touched.
        """
        fold(slots, period, soft, variance, FADE, self._rings, self._last)

    def before(self, slots: Index, period: Index) -> tuple[Array, Array]:
        """Sum and weight gathered so far for one running period of each lamp; 0 if it is new. Both (L,)."""
        at = period % FRAME_BITS
        same = self._last[slots, at] == period
        return np.where(same, self._sum[slots, at], 0.0), np.where(same, self._weight[slots, at], 0.0)

    def frames(self, slots: Index, codes: Index, period: Index) -> list[tuple[int, LampFrame]]:
        """Read the frames of those lamps of which every bit is known; slots with what was read.

        ``period`` is each lamp's running number now, which paces the attempts; all (L,).
        """
        due = (period >= self._due[slots]).nonzero()[0]
        if not len(due):
            return []
        rows = slots[due]
        known = self._sum[rows] ** 2 > KNOWN**2 * self._weight[rows]  # never without any weight
        found = []
        for k in due[known.all(axis=1)]:
            slot = int(slots[k])
            self._due[slot] = period[k] + RETRY
            bits = int.from_bytes(np.packbits(self._sum[slot] < 0.0).tobytes(), "big") >> -FRAME_BITS % 8
            frame = decode_ring(bits, int(codes[k]))
            if frame is not None:
                found.append((slot, frame))
        return found
