"""Calls that block: what becomes of them, and that a stop does not wait for them."""

import asyncio
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import pytest

from hal.blocking_calls import run_in_thread
from hal.net import inet
from hal.port.opening import open_port


async def test_what_it_returns_and_raises_is_had_where_it_is_awaited() -> None:
    assert await run_in_thread(threading.current_thread, "x") is not threading.current_thread()
    with pytest.raises(ValueError, match="invalid literal"):
        await run_in_thread(partial(int, "x"), "x")


def test_nobody_minds_the_end_of_what_was_given_up() -> None:
    async def run() -> None:
        go = threading.Event()
        work = run_in_thread(go.wait, "x")
        work.cancel()
        go.set()
        await asyncio.sleep(0.02)

    asyncio.run(run(), debug=True)


@pytest.mark.parametrize(
    ("blocked", "wait_for"),
    [
        ("socket.getaddrinfo", lambda: inet.resolve("robot.invalid", 1)),
        ("hal.port.serial_port.serial.Serial", lambda: open_port("/dev/nowhere", 9600)),
        ("socket.getaddrinfo", lambda: open_port("tcp://robot.invalid", 0)),
    ],
    ids=["names", "serial line", "name of a sensor"],
)
def test_a_stop_does_not_wait_for_a_call_that_hangs(
    blocked: str, wait_for: Callable[[], Awaitable[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    released, known = threading.Event(), socket.getaddrinfo

    def hang(*args: Any, flags: int = 0, **kwargs: Any) -> Any:
        if flags & socket.AI_NUMERICHOST:
            return known(*args, flags=flags, **kwargs)
        released.wait(5.0)
        raise OSError("given up")

    monkeypatch.setattr(blocked, hang)

    async def run() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(wait_for(), 0.05)

    begun = time.monotonic()
    asyncio.run(run())
    took = time.monotonic() - begun
    released.set()
    assert took < 2.0
