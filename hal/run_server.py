"""What the small programs share that serve a device until they are told to stop."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Coroutine
from typing import Any


def say(text: str) -> None:
    """A line for whoever started this process."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def stopping() -> asyncio.Event:
    """What is set by SIGINT or SIGTERM, from now on; in a running loop."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    return stop


async def until_told(seconds: float = 0.0) -> None:
    """Wait for SIGINT or SIGTERM, or for a time."""
    stop = stopping()
    if seconds > 0:
        asyncio.get_running_loop().call_later(seconds, stop.set)
    await stop.wait()


async def work_until_told(*works: Coroutine[Any, Any, None], seconds: float = 0.0) -> None:
    """Work until :func:`until_told` returns; one that fails ends all, and what it raises is raised here."""
    told = asyncio.create_task(until_told(seconds))
    tasks = [asyncio.create_task(work) for work in works]
    try:
        pending = {told, *tasks}
        while told in pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
    finally:
        for task in (told, *tasks):
            task.cancel()
        await asyncio.gather(told, *tasks, return_exceptions=True)
