"""How a driver stays with its device: connection after connection, until it is cancelled."""

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
    """Open anew whatever has ended, after a pause.

    Args:
        status: its ``link`` is WAITING between two connections, and CLOSED at the end.
        connection: one from its opening to its end, which raises `HalError` where there is something to be noted.
        note: keeps what a connection ended with.
        pause: seconds until the next.
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
