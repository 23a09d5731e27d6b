"""Soft-bit accumulator: sums the data bits of tracked lamps over repetitions of their frames until they decode."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.correlation_kernels import fold
from estimator.cdma.data_frame import FRAME_BITS, LampFrame, decode_ring
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

KNOWN: Final = 3.0
"""Standard deviations from zero beyond which a bit counts as received; the CRC detects up to three wrong bits."""

FADE: Final = 0.7
"""Weight of the previous repetition of a bit: a lamp with a changed frame is decoded in 9 s."""

RETRY: Final = 29
"""New bits before another attempt at a frame that failed its check: a quarter of it."""


class BitRings:
    """Soft bits of all tracked lamps, folded on the frame's length, so that weak lamps gain by repetition."""

    def __init__(self, capacity: int) -> None:
        """``capacity``: number of slots."""
        self._rings: Array = np.zeros((2, capacity, FRAME_BITS))  # sums and weights
        self._last: Index = np.full((capacity, FRAME_BITS), -1)
        self._due: Index = np.zeros(capacity, np.int64)

    @property
    def _sum(self) -> Array:
        """(capacity, FRAME_BITS) sum of soft / variance."""
        view: Array = self._rings[0]  # not stored: a pickled view would become an array of its own
        return view

    @property
    def _weight(self) -> Array:
        """(capacity, FRAME_BITS) sum of 1 / variance."""
        view: Array = self._rings[1]
        return view

    def forget(self, slot: int) -> None:
        """Clear a slot for another lamp."""
        self._sum[slot], self._weight[slot], self._last[slot], self._due[slot] = 0.0, 0.0, -1, 0

    def add(self, slots: Index, period: Index, soft: Array, variance: Array) -> None:
        """Add the soft bits of one block.

        Args:
            slots: (L,).
            period: (L,) running number of the first code period touched, not folded.
            soft: (L, P) amplitude times sign of each period touched.
            variance: (L, P), inf where not touched.
        """
        fold(slots, period, soft, variance, FADE, self._rings, self._last)

    def before(self, slots: Index, period: Index) -> tuple[Array, Array]:
        """Sum and weight so far of one running period of each lamp, both (L,); 0 if the period is new."""
        at = period % FRAME_BITS
        same = self._last[slots, at] == period
        return np.where(same, self._sum[slots, at], 0.0), np.where(same, self._weight[slots, at], 0.0)

    def frames(self, slots: Index, codes: Index, period: Index) -> list[tuple[int, LampFrame]]:
        """Decode the frames of the lamps whose bits are all received; returns (slot, frame).

        ``period`` is each lamp's current running number, which spaces the attempts; all arrays (L,).
        """
        due = (period >= self._due[slots]).nonzero()[0]
        if not len(due):
            return []
        rows = slots[due]
        known = self._sum[rows] ** 2 > KNOWN**2 * self._weight[rows]  # False where the weight is 0
        found = []
        for k in due[known.all(axis=1)]:
            slot = int(slots[k])
            self._due[slot] = period[k] + RETRY
            bits = int.from_bytes(np.packbits(self._sum[slot] < 0.0).tobytes(), "big") >> -FRAME_BITS % 8
            frame = decode_ring(bits, int(codes[k]))
            if frame is not None:
                found.append((slot, frame))
        return found
