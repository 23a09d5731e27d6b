"""Converts bus transactions to sample blocks: words, times, blemishes."""

from __future__ import annotations

from typing import Final

from hal.adc import Blemish, RawSamples
from hal.bus.i2c import Transferred
from hal.photodiode.adapter_limits import AdapterLimits
from hal.photodiode.block_check import BlockDefects, inspect
from hal.photodiode.chips import CLOCKS_PER_WORD, BlockChip
from hal.photodiode.timebase import SclClock

IDLE_S: Final = 0.1
"""After a pause this long the first conversion is dropped: its sample dates from the end of the last transaction."""


class Sampler:
    """Makes sample blocks of one stream of equal reads.

    Args:
        chip: the converter. found: the adapter's measured limits. first: number of the first block.
    """

    def __init__(self, chip: BlockChip, found: AdapterLimits, first: int = 0) -> None:
        self._chip, self._length, self._seq = chip, found.length, first
        self.scl = SclClock(found.length, found.span_s, found.short_s, found.spread_s)
        self._dropped = 0
        self._bus_rests_since: float | None = None

    @property
    def next_seq(self) -> int:
        """Number of the next block; dropped blocks have numbers, too."""
        return self._seq

    def to_block(self, done: Transferred, dropped: int) -> tuple[RawSamples, BlockDefects]:
        """Build one block and count its defects.

        Args:
            done: the transaction.
            dropped: blocks dropped by the loop since the stream began.
        """
        timing = self.scl.add(done.t0, done.t1)
        words, blemish, defects = inspect(done.reads[0], self._length, self._chip.spare, self._chip.bits)
        t_first = timing.t_first
        if self._bus_rests_since is None or done.t0 - self._bus_rests_since > IDLE_S:
            words, t_first = words[1:], t_first + 1.0 / timing.rate_hz
        if self._misses(done, dropped):
            blemish |= Blemish.GAP
        if timing.stretched:
            blemish |= Blemish.STRETCHED
        self._seq += dropped - self._dropped
        self._dropped, self._bus_rests_since = dropped, done.t1 - timing.excess_s
        block = RawSamples(
            self._seq, done.t0, done.t1, t_first, timing.rate_hz, words, self._chip.bits, blemish, timing.slack_s
        )
        self._seq += 1
        return block, defects

    def _misses(self, done: Transferred, dropped: int) -> bool:
        """Whether a block is missing before this one."""
        if self._bus_rests_since is None:
            return self._seq > 0
        return dropped != self._dropped or done.t0 - self._bus_rests_since > done.t1 - done.t0


def describe(sampler: Sampler, found: AdapterLimits, chip: BlockChip, about: str) -> dict[str, str]:
    """The facts of a converter for `lumiloop status`."""
    hz = sampler.scl.hz
    facts = {
        "chip": chip.name,
        "adapter": about,
        "scl": f"{1e-3 * hz:.2f} kHz",
        "rate": f"{hz / CLOCKS_PER_WORD:.1f} /s",
        "block": f"{found.length // 2} samples, {9e3 * found.length / hz:.1f} ms",
        "spread": f"{1e6 * sampler.scl.spread_s:.0f} us",
        "late": f"{100 * sampler.scl.late_share:.0f} %",
    }
    if found.limit:
        facts["limit"] = found.limit
    if hz > 1.02 * chip.scl_max_hz:
        facts["warning"] = f"SCL is faster than the {1e-3 * chip.scl_max_hz:.0f} kHz of a {chip.name}"
    return {key: value for key, value in facts.items() if value}
