"""A watchdog around an I2C bus: reports silence after five blocks, and a transaction that hangs."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Final

from hal.adc import BusStuck
from hal.bus.i2c import NACKS, AsyncBus, Message, OnRead, Transferred
from hal.errors import DeviceFault, HalError

BLOCKS: Final = 5
FLOOR_S: Final = 0.1
"""Silence is not reported before this, however short the blocks are."""
HANG_S: Final = 3.0
"""A transaction that has not returned for this long hangs in the kernel: every time-out has passed."""

Explain = Callable[[OSError], HalError]
OnSilence = Callable[[HalError, bool], None]
"""Called with the error, and whether it is certain: a first silence may end before it needs a log line."""


class WatchedBus:
    """A :class:`hal.bus.i2c.AsyncBus` around another.

    Args:
        bus: the other. block_s: length of blocks.
        explain: converts a transaction's error. on_silence: called for silence and for its cause.
    """

    def __init__(self, bus: AsyncBus, block_s: float, explain: Explain, on_silence: OnSilence) -> None:
        self._bus, self._patience_s = bus, max(FLOOR_S, BLOCKS * block_s)
        self._explain, self._on_silence = explain, on_silence
        self._loop = asyncio.get_running_loop()
        self._t_read = self._t_back = self._loop.time()
        self._failure: OSError | None = None
        self._active = asyncio.Event()
        self._active.set()

    @property
    def name(self) -> str:
        """See :attr:`hal.bus.i2c.Bus.name`."""
        return self._bus.name

    @property
    def about(self) -> str:
        """See :attr:`hal.bus.i2c.Bus.about`."""
        return self._bus.about

    async def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction; raises `OSError`."""
        try:
            done = await self._bus.transfer(messages)
        except OSError as error:
            if error.errno in NACKS and messages[0].data:  # a chip without registers does not acknowledge
                self._returned()
            else:
                self._failed(error)
            raise
        self._returned()
        return done

    async def stream(self, messages: tuple[Message, ...], on_read: OnRead) -> None:
        """Repeat one transaction until cancelled; raises `OSError`."""

        def pass_on(done: Transferred, dropped: int) -> None:
            self._returned()
            on_read(done, dropped)

        try:
            await self._bus.stream(messages, pass_on)
        except OSError as error:
            self._failed(error)
            raise

    async def close(self) -> None:
        """Close; idempotent."""
        await self._bus.close()

    async def watch(self) -> None:
        """Report silence until cancelled."""
        while True:
            left = self._t_read + self._patience_s - self._loop.time()
            if left > 0.0:
                await asyncio.sleep(left)
                continue
            self._active.clear()
            failure = self._failure
            self._on_silence(self._explain(failure) if failure else self._silent_error(), failure is not None)
            await self._until_active()

    async def _until_active(self) -> None:
        hangs = False
        while not self._active.is_set():
            left = self._t_back + HANG_S - self._loop.time()
            if left <= 0.0 and not hangs:
                hangs = True
                self._on_silence(self._hang_error(), True)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._active.wait(), None if hangs else left)

    def _returned(self) -> None:
        self._t_read = self._t_back = self._loop.time()
        self._failure = None
        self._active.set()

    def _failed(self, error: OSError) -> None:
        self._t_back, self._failure = self._loop.time(), error
        if not self._active.is_set():
            self._on_silence(self._explain(error), True)

    def _silent_error(self) -> HalError:
        return DeviceFault(
            self.name,
            f"no data were read for {BLOCKS} blocks",
            "the daemon tries again; if it persists, check the wiring and the kernel log",
        )

    def _hang_error(self) -> HalError:
        return BusStuck(
            self.name,
            f"a transaction has not returned for {HANG_S:g} s",
            "the adapter's driver does not respond; unbind and bind it, or restart the computer",
        )
