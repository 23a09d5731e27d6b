"""A thread of its own for a blocking bus."""

import asyncio
import errno
import threading
import time
from collections.abc import Callable, Generator
from itertools import pairwise

import pytest

from hal.bus.i2c import Message, Transferred, read
from hal.bus.i2c_thread import ThreadedBus, open_threaded
from hal.errors import DeviceMissing, DeviceRefused

BLOCK = (read(0x4D, 60),)
WORD = (read(0x4D, 2),)


class Slow:
    """A bus whose reads take a while and are numbered."""

    name, about = "slow", "an adapter"

    def __init__(self, seconds: float = 0.01) -> None:
        self.seconds = seconds
        self.done = 0
        self.closed = threading.Event()
        self.released = threading.Event()
        self.hangs = self.given_up = False
        self.fails: dict[int, Exception] = {}
        self.threads: set[str] = set()

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        self.threads.add(threading.current_thread().name)
        if self.hangs:
            self.released.wait(10.0)
        t0 = time.monotonic()
        time.sleep(self.seconds)
        self.done += 1
        if self.done in self.fails:
            raise self.fails[self.done]
        return Transferred(t0, time.monotonic(), (self.done.to_bytes(2, "big") * (messages[0].length // 2),))

    def repeat(self, messages: tuple[Message, ...]) -> Generator[Transferred]:
        while True:
            yield self.transfer(messages)

    def release(self) -> None:
        self.given_up = True

    def close(self) -> None:
        self.closed.set()


def number(done: Transferred) -> int:
    return int.from_bytes(done.reads[0][:2], "big")


async def until(so: Callable[[], bool]) -> None:
    end = time.monotonic() + 5.0
    while not so():
        assert time.monotonic() < end
        await asyncio.sleep(0.001)


async def opened(slow: Slow) -> ThreadedBus:
    return await open_threaded("slow", lambda _name: slow)


async def test_one_thread_does_all_transactions() -> None:
    slow = Slow()
    bus = await opened(slow)
    assert bus.name == "slow"
    assert bus.about == "an adapter"
    both = await asyncio.gather(bus.transfer(WORD), bus.transfer(WORD))
    assert [number(done) for done in both] == [1, 2]
    await bus.close()
    assert slow.closed.is_set()
    assert slow.threads == {"i2c slow"}
    await bus.close()


async def test_a_stream_and_transactions_in_between() -> None:
    slow = Slow()
    bus = await opened(slow)
    got: list[Transferred] = []
    task = asyncio.create_task(bus.stream(BLOCK, lambda done, dropped: got.append(done)))
    await until(lambda: len(got) >= 3)
    between = await bus.transfer(WORD)
    await until(lambda: len(got) >= 6)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    numbers = sorted([*(number(done) for done in got), number(between)])
    assert len(set(numbers)) == len(numbers)
    assert len(between.reads[0]) == 2
    after = await bus.transfer(WORD)
    assert number(after) > max(numbers)
    seen = len(got)
    await asyncio.sleep(0.05)
    assert len(got) == seen  # a stream that was cancelled delivers nothing more
    await bus.close()


async def test_latest_wins_and_what_was_dropped_is_counted() -> None:
    slow = Slow(0.005)
    bus = await opened(slow)
    got: list[tuple[int, int]] = []
    task = asyncio.create_task(bus.stream(BLOCK, lambda done, dropped: got.append((number(done), dropped))))
    await until(lambda: len(got) >= 3)
    time.sleep(0.1)  # noqa: ASYNC251 - the loop has no time, that is the test
    await until(lambda: len(got) >= 6)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await bus.close()
    numbers = [n for n, _ in got]
    assert numbers == sorted(set(numbers))
    assert got[-1][1] >= 3
    for (early, dropped_before), (late, dropped_after) in pairwise(got):
        assert late - early == 1 + dropped_after - dropped_before


async def test_an_error_ends_the_stream_and_not_the_bus() -> None:
    slow = Slow()
    slow.fails = {3: OSError(errno.EIO, "Input/output error")}
    bus = await opened(slow)
    with pytest.raises(OSError, match="Input/output"):
        await asyncio.wait_for(bus.stream(BLOCK, lambda done, dropped: None), 5.0)
    assert number(await bus.transfer(WORD)) == 4
    await bus.close()


async def test_nothing_dies_silently() -> None:
    """An error that no bus should raise is raised where the transaction was ordered."""
    slow = Slow()
    slow.fails = {1: RuntimeError("a bug"), 3: RuntimeError("another")}
    bus = await opened(slow)
    with pytest.raises(RuntimeError, match="a bug"):
        await bus.transfer(WORD)
    with pytest.raises(RuntimeError, match="another"):
        await asyncio.wait_for(bus.stream(BLOCK, lambda done, dropped: None), 5.0)
    assert number(await bus.transfer(WORD)) == 4
    await bus.close()


async def test_what_an_open_raises_is_raised() -> None:
    def refuse(name: str) -> Slow:
        raise DeviceRefused(name, "permission denied")

    with pytest.raises(DeviceRefused, match="permission denied"):
        await open_threaded("slow", refuse)
    for thread in [thread for thread in threading.enumerate() if thread.name == "i2c slow"]:
        thread.join(4.0)
        assert not thread.is_alive()


async def test_a_transaction_that_hangs_does_not_hold_up_the_loop() -> None:
    slow = Slow()
    slow.hangs = True
    bus = await opened(slow)
    task = asyncio.create_task(bus.stream(BLOCK, lambda done, dropped: None))
    await asyncio.sleep(0.02)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    before = time.monotonic()
    await bus.close()
    assert time.monotonic() - before < 1.0
    assert not slow.closed.is_set()
    slow.released.set()
    assert slow.closed.wait(4.0)  # it ends by itself when the kernel lets go


async def test_an_open_that_was_given_up_is_closed_when_it_returns() -> None:
    slow, go = Slow(), threading.Event()

    def late(_name: str) -> Slow:
        go.wait(5.0)
        return slow

    task = asyncio.create_task(open_threaded("slow", late))
    await asyncio.sleep(0.02)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    go.set()
    assert slow.closed.wait(4.0)


def test_a_loop_that_has_ended_ends_the_thread() -> None:
    slow = Slow()

    async def main() -> None:
        bus = await opened(slow)
        task = asyncio.create_task(bus.stream(BLOCK, lambda done, dropped: None))
        await asyncio.sleep(0.03)
        task.cancel()

    asyncio.run(main())
    assert slow.closed.wait(4.0)


def test_a_loop_that_has_ended_ends_a_thread_without_work() -> None:
    slow = Slow()

    async def main() -> None:
        await opened(slow)

    asyncio.run(main())
    assert slow.closed.wait(4.0)


def test_opening_a_bus_that_is_not_there() -> None:
    from hal.bus.opening import open_bus

    with pytest.raises(DeviceMissing, match="no such bus"):
        asyncio.run(open_bus("/dev/i2c-250"))
