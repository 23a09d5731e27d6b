"""Calls that block, beside the event loop.

The loop's own threads are waited for at the end of `asyncio.run`: a name server that does not answer, or a wedged
adapter that is being opened, would hold up a stop for as long as they please. These threads die with the process.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

T = TypeVar("T")


def beside(work: Callable[[], T], name: str) -> asyncio.Future[T]:
    """Run in a thread of its own, called ``lumiloop-`` and ``name``, for which nobody waits at a stop.

    Raises:
        RuntimeError: the system has no thread left.
    """
    loop = asyncio.get_running_loop()
    ended: asyncio.Future[T] = loop.create_future()

    def end(settle: Callable[[], None]) -> None:
        if not ended.done():  # it may have been cancelled
            settle()

    def run() -> None:
        try:
            settle = partial(ended.set_result, work())
        except Exception as error:  # noqa: BLE001  raised again where it is awaited
            settle = partial(ended.set_exception, error)
        with contextlib.suppress(RuntimeError):  # the loop has closed: nobody waits any more
            loop.call_soon_threadsafe(end, settle)

    threading.Thread(target=run, name=f"lumiloop-{name}", daemon=True).start()
    return ended
