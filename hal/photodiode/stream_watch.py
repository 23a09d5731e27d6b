"""Watches a running sample stream: transactions to checked blocks, and detection of the conditions that end it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hal.adc import RawSamples
from hal.bus.i2c import Transferred
from hal.errors import HalError
from hal.photodiode.diagnosis import BlockDiagnosis
from hal.photodiode.sampler import Sampler


@dataclass(frozen=True, slots=True)
class CheckedBlock:
    """One block with its diagnosis.

    Attributes:
        sound: the chip can have sent it. dropped: blocks dropped by the loop since the stream began.
        error: a lasting condition of light or adapter; None: none.
    """

    block: RawSamples
    sound: bool
    dropped: int
    error: HalError | None


OnBlock = Callable[[CheckedBlock], None]


class StreamWatch:
    """Receives the transactions of one stream and detects its end.

    Args:
        sampler: builds blocks. diagnosis: over many blocks. on_block: receives each.
        kept_s: the measurement of the adapter is kept at least this long, in spite of doubt.
    """

    def __init__(self, sampler: Sampler, diagnosis: BlockDiagnosis, on_block: OnBlock, kept_s: float) -> None:
        self._sampler, self._diagnosis, self._on_block = sampler, diagnosis, on_block
        self._loop = asyncio.get_running_loop()
        self._trouble: asyncio.Future[HalError | None] = self._loop.create_future()
        self._kept_until = self._loop.time() + kept_s

    def receive(self, done: Transferred, dropped: int) -> None:
        """Process one transaction of the bus."""
        if self._trouble.done():
            return
        block, defects = self._sampler.to_block(done, dropped)
        verdict = self._diagnosis.add(block, defects)
        self._on_block(CheckedBlock(block, verdict.sound, dropped, verdict.error))
        if verdict.again:
            self._trouble.set_result(verdict.error)
        elif self._sampler.scl.doubt and self._loop.time() > self._kept_until:
            self._trouble.set_result(None)

    async def watch(self, jobs: Sequence[asyncio.Task[None]]) -> None:
        """Return when the adapter must be measured again; raise any other end of the stream.

        Raises:
            OSError: from a job. HalError: the chip must be identified again.
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
