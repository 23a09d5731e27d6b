"""Acquisition budget: share of the offered effort that a search for further lamps deserves.

An untracked lamp stays in the residual of the joint fit. Three conditions make the decoder calm. The residual is at its
usual noise, all tracked lamps are received, and the sweeps since then found nothing. Any further lamp is then too weak
to be distinguished from noise without its code. The search continues with a small share of the effort. It returns to
all of it at once when a condition ends.

A lamp of amplitude A adds A^2 to the residual's variance per sample. Its correlation over n samples adds n A^2 to that
of its own detector. A rise of the noise by `RISE` is a lamp 15 times its noise (n = 1111). The very next sweep finds
it. A weaker lamp above the detection threshold of 5.2 takes up to `LONGEST` blocks: two slow sweeps and the blocks that
confirm it. Codes outside the survey take turns in slow sweeps, `TURNS` sweeps for all of them. A lamp outside the
survey may be reported later, and most codes belong to no lamp.
"""

from __future__ import annotations

from math import ceil
from typing import Final

RISE: Final = 1.1
"""Noise of a block over its usual level that indicates an untracked lamp: 4 sigmas of chance in 1111 samples."""

EMPTY: Final = 2
"""Sweeps in a row without a find before the search is calm; in a single one the strongest lamp may hide the rest."""

SPREAD: Final = 6
"""Blocks over which a calm sweep is spread."""

LONGEST: Final = 2 * SPREAD + 4
"""Blocks until a new lamp is reported, however weak. The effort offered must be at least `1 / SPREAD` of the codes per
block. The sweep in progress began before the lamp, the next one finds it, and the remaining blocks confirm it.
"""

TURNS: Final = 4
"""Slow sweeps that together cover every code outside the survey."""

LONGEST_FOREIGN: Final = (TURNS + 1) * SPREAD + 4
"""Blocks until a new lamp is reported whose code is outside the survey."""


class Watch:
    """Counts the evidence against further lamps, and limits the codes to be searched.

    Attributes:
        empty: sweeps in a row without a find. left: codes that may still be searched before the next block, if calm.
    """

    def __init__(self, codes: int) -> None:
        """``codes``: number of codes of a slow sweep."""
        self.empty = self.left = self._lit = 0
        self._share = ceil(codes / SPREAD)

    @property
    def calm(self) -> bool:
        """Whether the evidence is that no further lamps are in view."""
        return self.empty >= EMPTY

    def on_block(self, lit: int, noise_ratio: float, odd: bool) -> None:
        """Update with a block.

        Args:
            lit: confirmed lamps received.
            noise_ratio: residual over its usual level (0: unknown).
            odd: whether the block has flags or the decoder has candidates.
        """
        if odd or lit < max(self._lit, 1) or not 0.0 < noise_ratio < RISE:
            self.empty = 0
        self._lit, self.left = lit, self._share

    def on_sweep(self, finds: int) -> None:
        """Update with the number of candidates of a finished sweep."""
        self.empty = 0 if finds else self.empty + 1

    def allow(self, codes: int) -> int:
        """How many of the codes offered may be searched."""
        return min(codes, self.left) if self.calm else codes

    def spend(self, codes: int) -> None:
        """Subtract codes that have been searched."""
        self.left = max(self.left - codes, 0)
