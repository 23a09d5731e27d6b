"""Follow a running stream: transactions to sample blocks, and a watch over the ways in which a stream can go wrong."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hal.adc import RawSamples
from hal.bus.i2c import Transferred
from hal.errors import HalError
from hal.photodiode.diagnosis import Judge
from hal.photodiode.sampler import Sampler


@dataclass(frozen=True, slots=True)
class Followed:
    """One block with what is known about it.

    Attributes:
        sound: the chip can have sent it. dropped: blocks the loop had no time for, since the stream began.
        error: what is wrong with light or adapter for longer than this block; None: nothing.
    """

    block: RawSamples
    sound: bool
    dropped: int
    error: HalError | None


OnBlock = Callable[[Followed], None]


class Follower:
    """Takes the transactions of one stream.

    Args:
        sampler: makes blocks. judge: looks at many of them. on_block: gets each.
        kept_s: what was measured of the adapter is kept at least this long, however doubtful it has become.
    """

    def __init__(self, sampler: Sampler, judge: Judge, on_block: OnBlock, kept_s: float) -> None:
        self._sampler, self._judge, self._on_block = sampler, judge, on_block
        self._loop = asyncio.get_running_loop()
        self._trouble: asyncio.Future[HalError | None] = self._loop.create_future()
        self._kept_until = self._loop.time() + kept_s

    def take(self, done: Transferred, dropped: int) -> None:
        """One transaction, from the bus."""
        if self._trouble.done():
            return
        block, census = self._sampler.take(done, dropped)
        verdict = self._judge.look(block, census)
        self._on_block(Followed(block, verdict.sound, dropped, verdict.error))
        if verdict.again:
            self._trouble.set_result(verdict.error)
        elif self._sampler.scl.doubt and self._loop.time() > self._kept_until:
            self._trouble.set_result(None)

    async def watch(self, jobs: Sequence[asyncio.Task[None]]) -> None:
        """Return when the adapter has to be measured again; raise whatever else ends the stream.

        Raises:
            OSError: from a job. HalError: the chip has to be looked at again.
        """
        watched: list[asyncio.Future[Any]] = [self._trouble, *jobs]
        while True:
            await asyncio.wait(watched, return_when=asyncio.FIRST_COMPLETED)
            if self._trouble.done():
                error = self._trouble.result()
                if error is None:
                    return
                raise error
            for job in jobs:
                if job.done():
                    job.result()
