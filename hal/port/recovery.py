"""The reconnect loop of a driver: open, run, pause, open again, until cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Protocol

from hal.errors import HalError
from hal.lidar import Link


class HasLink(Protocol):
    """The live state of a driver."""

    link: Link


async def stay_connected(
    status: HasLink,
    connection: Callable[[], Awaitable[None]],
    note: Callable[[HalError], None],
    pause: Callable[[], float],
) -> None:
    """Run connections one after the other, with a pause in between.

    Args:
        status: its ``link`` is WAITING between two connections, and CLOSED at the end.
        connection: runs one connection from open to end; raises `HalError` where the end has a cause.
        note: receives that error.
        pause: returns the seconds until the next connection.
    """
    try:
        while True:
            try:
                await connection()
            except HalError as error:
                note(error)
            status.link = Link.WAITING
            await asyncio.sleep(pause())
    finally:
        status.link = Link.CLOSED
