"""What the small programs share that serve a device until they are told to stop."""

from __future__ import annotations

import asyncio
import signal
import sys


def say(text: str) -> None:
    """A line for whoever started this process."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


async def until_told(seconds: float = 0.0) -> None:
    """Wait for SIGINT or SIGTERM, or for a time."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    if seconds > 0:
        loop.call_later(seconds, stop.set)
    await stop.wait()
