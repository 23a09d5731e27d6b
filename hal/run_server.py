"""Start and stop of small server processes: output lines, SIGINT and SIGTERM."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Coroutine
from typing import Any


def print_line(text: str) -> None:
    """Write one line to standard output and flush it."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def stop_event() -> asyncio.Event:
    """Return an event of the running loop that SIGINT and SIGTERM set from now on."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    return stop


async def until_stopped(seconds: float = 0.0) -> None:
    """Wait for SIGINT or SIGTERM, at most ``seconds`` (0: no limit)."""
    stop = stop_event()
    if seconds > 0:
        asyncio.get_running_loop().call_later(seconds, stop.set)
    await stop.wait()


async def run_until_stopped(*works: Coroutine[Any, Any, None], seconds: float = 0.0) -> None:
    """Run ``works`` until :func:`until_stopped` returns; the first failure cancels all and is raised here."""
    stopped = asyncio.create_task(until_stopped(seconds))
    tasks = [asyncio.create_task(work) for work in works]
    try:
        pending = {stopped, *tasks}
        while stopped in pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
    finally:
        for task in (stopped, *tasks):
            task.cancel()
        await asyncio.gather(stopped, *tasks, return_exceptions=True)
