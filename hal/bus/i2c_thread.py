"""Runs a blocking I2C bus in a thread of its own and delivers its transactions to the event loop.

The thread does nothing but transactions. One finished block waits for the loop; if the next one is complete before the
loop has received it, it is dropped and counted. The interpreter lock is free while the kernel works.

``t1`` is read after the thread has regained the interpreter lock. While the loop thread runs Python, ``t1`` is late by
up to the interpreter's switch interval. `hal.photodiode.sampler` marks such blocks. A bus server in a process of its
own (:mod:`hal.bus.i2c_server`) does not have them.
"""

from __future__ import annotations

import asyncio
import errno
import threading
from collections.abc import Callable
from contextlib import closing
from queue import Empty, SimpleQueue
from typing import Final

from hal.bus.i2c import Bus, Message, OnRead, Transferred

CLOSE_S: Final = 0.25
"""A close waits this long for a transaction in the kernel; after that the thread ends by itself."""

IDLE_S: Final = 1.0
"""Interval at which an idle thread checks whether its loop still runs: a loop that just ended closes no bus."""

Post = Callable[..., None]


class _Once:
    """A single transaction, ordered by the loop."""

    def __init__(self, messages: tuple[Message, ...], future: asyncio.Future[Transferred], post: Post) -> None:
        self.messages, self.future, self.post = messages, future, post

    def run(self, bus: Bus) -> None:
        try:
            done = bus.transfer(self.messages)
        except Exception as error:  # noqa: BLE001 - raised again in the loop
            self.post(_fail, self.future, error)
        else:
            self.post(_succeed, self.future, done)


class _Stream:
    """A repeated transaction."""

    def __init__(self, messages: tuple[Message, ...], on_read: OnRead, ended: asyncio.Future[None], post: Post) -> None:
        self.messages, self.on_read, self.ended, self.post = messages, on_read, ended, post
        self.stopped = False
        self._lock = threading.Lock()
        self._latest: Transferred | None = None
        self._dropped = 0

    def put(self, done: Transferred) -> None:
        """In the thread: pass a block to the loop."""
        with self._lock:
            fresh = self._latest is None
            self._dropped += not fresh
            self._latest = done
        if fresh:
            self.post(self._deliver)

    def _deliver(self) -> None:
        with self._lock:
            done, self._latest = self._latest, None
            dropped = self._dropped
        if done is not None and not self.stopped:
            self.on_read(done, dropped)


_Job = _Once | _Stream


class ThreadedBus:
    """A :class:`hal.bus.i2c.AsyncBus` over a blocking bus. Made by :func:`open_threaded`.

    Args:
        name: of the bus. opener: opens it, in the thread.
    """

    def __init__(self, name: str, opener: Callable[[str], Bus]) -> None:
        self._name, self._about = name, ""
        self._bus: Bus | None = None
        self._loop = asyncio.get_running_loop()
        self._jobs: SimpleQueue[_Job | None] = SimpleQueue()
        self.opened: asyncio.Future[None] = self._loop.create_future()
        self._ended = asyncio.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._work, args=(opener,), name=f"i2c {name}", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """See :attr:`hal.bus.i2c.Bus.name`."""
        return self._name

    @property
    def about(self) -> str:
        """See :attr:`hal.bus.i2c.Bus.about`."""
        return self._about

    async def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction; raises `OSError`, ENODEV after the bus was closed."""
        self._check_open()
        future: asyncio.Future[Transferred] = self._loop.create_future()
        self._jobs.put(_Once(messages, future, self._post))
        return await future

    async def stream(self, messages: tuple[Message, ...], on_read: OnRead) -> None:
        """Repeat one transaction until cancelled; raises the `OSError` that ends it."""
        self._check_open()
        ended: asyncio.Future[None] = self._loop.create_future()
        job = _Stream(messages, on_read, ended, self._post)
        self._jobs.put(job)
        try:
            await ended
        finally:
            job.stopped = True

    async def close(self) -> None:
        """End the thread, which closes the bus; a transaction that hangs is abandoned and its address lock released."""
        if not self._closed:
            self._closed = True
            self._jobs.put(None)
        try:
            await asyncio.wait_for(self._ended.wait(), CLOSE_S)
        except TimeoutError:
            if self._bus is not None:
                self._bus.release()

    def _check_open(self) -> None:
        if self._closed:
            raise OSError(errno.ENODEV, "the bus is closed")

    # in the thread

    def _post(self, call: Callable[..., None], *arguments: object) -> None:
        try:
            self._loop.call_soon_threadsafe(call, *arguments)
        except RuntimeError:  # the loop has been closed
            self._jobs.put(None)

    def _work(self, opener: Callable[[str], Bus]) -> None:
        try:
            bus = opener(self._name)
        except Exception as error:  # noqa: BLE001 - raised again where the bus was opened
            self._post(_fail, self.opened, error)
            return
        self._bus, self._about = bus, bus.about
        self._post(_succeed, self.opened, None)
        with closing(bus):
            while (job := self._next()) is not None:
                self._run(job, bus)
        self._post(self._ended.set)

    def _next(self) -> _Job | None:
        """Wait for the next job; None when the bus is to be closed or the loop has been closed."""
        while not self._loop.is_closed():
            try:
                return self._jobs.get(timeout=IDLE_S)
            except Empty:
                continue
        return None

    def _run(self, job: _Job, bus: Bus) -> None:
        if isinstance(job, _Once):
            job.run(bus)
            return
        try:
            with closing(bus.repeat(job.messages)) as transactions:
                for done in transactions:
                    job.put(done)
                    if job.stopped or not self._run_waiting(bus):
                        return
        except Exception as error:  # noqa: BLE001 - raised again in the loop
            self._post(_fail, job.ended, error)

    def _run_waiting(self, bus: Bus) -> bool:
        """Run the jobs ordered meanwhile; False where the stream must end for another one."""
        while not self._jobs.empty():
            job = self._jobs.get()
            if not isinstance(job, _Once):
                self._jobs.put(job)
                return False
            job.run(bus)
        return True


def _fail(future: asyncio.Future[object], error: Exception) -> None:
    if not future.done():
        future.set_exception(error)


def _succeed(future: asyncio.Future[object], result: object) -> None:
    if not future.done():
        future.set_result(result)


async def open_threaded(name: str, opener: Callable[[str], Bus]) -> ThreadedBus:
    """Open a bus in a new thread; raises what ``opener`` raises (`HalError`)."""
    bus = ThreadedBus(name, opener)
    try:
        await bus.opened
    except asyncio.CancelledError:
        bus._jobs.put(None)  # closes the bus when the open returns
        raise
    return bus
