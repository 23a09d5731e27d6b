"""The kernel's timer and the loop's do the same: once, at the instant, the latest order counts."""

import asyncio
import time
from collections.abc import Callable

import pytest

from hal.timerfd import KernelTimer, LoopTimer, Timer, timer

Make = Callable[[asyncio.AbstractEventLoop, Callable[[], object]], Timer]


@pytest.mark.parametrize("make", [KernelTimer, LoopTimer])
async def test_once_and_not_before_the_latest_instant_ordered(make: Make) -> None:
    loop, rung = asyncio.get_running_loop(), list[float]()
    one = make(loop, lambda: rung.append(loop.time()))
    due = loop.time() + 0.06
    one.at(loop.time() + 0.01)
    one.at(due)
    await asyncio.sleep(0.2)
    one.close()
    one.close()
    (late,) = [at - due for at in rung]
    assert late >= -1e-4, "not at the instant ordered first, 0.05 s before"


@pytest.mark.parametrize("make", [KernelTimer, LoopTimer])
async def test_what_is_past_is_at_once_and_what_is_closed_is_never(make: Make) -> None:
    loop, rung = asyncio.get_running_loop(), list[None]()
    one, other = make(loop, lambda: rung.append(None)), make(loop, lambda: rung.append(None))
    one.at(loop.time() - 5.0)
    other.at(loop.time() + 0.01)
    other.close()
    await asyncio.sleep(0.1)
    one.close()
    assert len(rung) == 1


async def test_an_order_that_replaces_one_that_has_just_come_due_rings_once() -> None:
    loop, rung = asyncio.get_running_loop(), list[None]()
    one = KernelTimer(loop, lambda: rung.append(None))
    one.at(loop.time() + 0.01)
    time.sleep(0.03)  # noqa: ASYNC251  # it is due, and the loop has not seen it
    one.at(loop.time() + 0.03)
    await asyncio.sleep(0.2)
    one.close()
    assert len(rung) == 1


@pytest.mark.virtual
async def test_virtual_time_has_the_loops_own() -> None:
    loop, done = asyncio.get_running_loop(), asyncio.Event()
    one = timer(loop, done.set)
    assert isinstance(one, LoopTimer)
    one.at(3600.0)
    await done.wait()
    assert loop.time() == 3600.0
