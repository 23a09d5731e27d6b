"""Shared by the tests that run a whole daemon."""

import asyncio
from collections.abc import Awaitable

from daemon.app import Daemon


async def during(daemon: Daemon, scenario: Awaitable[None]) -> None:
    """Run the daemon around a scenario, and stop it as a signal would."""
    stop = asyncio.Event()
    running = asyncio.create_task(daemon.run(stop))
    try:
        await scenario
    finally:
        stop.set()
        await asyncio.wait_for(running, 10.0)
