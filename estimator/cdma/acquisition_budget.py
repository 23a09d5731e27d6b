"""How much of the effort a search for further lamps is worth.

A lamp that nobody follows is left over in the residual of the joint fit. While the residual stays at its usual noise,
all lamps that were followed are seen, and the blocks since then have been looked through without a find, there can be
only a lamp too weak to be told from noise without its code. For those the search goes on with a small part of the
effort; with all of it, at once, when any of this ends.

A lamp of amplitude A adds A^2 to the residual's variance per sample as its correlation over n samples adds n A^2 to
that of its own detector: a rise of the noise by `RISE` is a lamp 15 times its noise (n = 1111), which the very next
sweep finds. One between the search's threshold of 5.2 and that takes up to two slow sweeps and the blocks that confirm
it: `LONGEST` blocks. Codes that no lamp of the survey has take turns there, `TURNS` sweeps for all of them: a lamp that
hangs in no survey may be told later, and most codes hang nowhere.
"""

from __future__ import annotations

from math import ceil
from typing import Final

RISE: Final = 1.1
"""Noise of a block over its usual level from which something is left over: 4 sigmas of chance in 1111 samples."""

EMPTY: Final = 2
"""Sweeps in a row without a find after which there is nothing to be found: of one, the strongest may hide the rest."""

SPREAD: Final = 6
"""Blocks over which a sweep is drawn out then."""

LONGEST: Final = 2 * SPREAD + 4
"""Blocks until a new lamp is reported, however weak, where the effort offered suffices for `1 / SPREAD` of the codes
per block: the sweep under way began before the lamp, the next finds it, and the rest is to confirm it."""

TURNS: Final = 4
"""Slow sweeps in which every code that does not hang here has its turn."""

LONGEST_FOREIGN: Final = (TURNS + 1) * SPREAD + 4
"""The same for a lamp whose code does not hang here."""


class Watch:
    """Counts what speaks against further lamps.

    Attributes:
        empty: sweeps in a row without a find. left: codes that may still be tried before the next block, if calm.
    """

    def __init__(self, codes: int) -> None:
        """``codes``: of a slow sweep."""
        self.empty = self.left = self._lit = 0
        self._share = ceil(codes / SPREAD)

    @property
    def calm(self) -> bool:
        """Whether there seems to be nothing to be found."""
        return self.empty >= EMPTY

    def on_block(self, lit: int, noise_ratio: float, odd: bool) -> None:
        """Hear of a block: confirmed lamps seen, residual over its usual level (0: unknown), flags or candidates."""
        if odd or lit < max(self._lit, 1) or not 0.0 < noise_ratio < RISE:
            self.empty = 0
        self._lit, self.left = lit, self._share

    def on_sweep(self, finds: int) -> None:
        """Hear of the end of a sweep."""
        self.empty = 0 if finds else self.empty + 1

    def allow(self, codes: int) -> int:
        """How many of the codes offered are to be tried."""
        return min(codes, self.left) if self.calm else codes

    def spend(self, codes: int) -> None:
        """So many have been."""
        self.left = max(self.left - codes, 0)
