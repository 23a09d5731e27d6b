"""Runs a blocking call in a thread that does not delay the end of the process.

`asyncio.run` waits for the loop's own executor threads at its end. A name server that does not answer, or the open of a
wedged adapter, would then hold up a stop without limit. The threads of this module are daemon threads.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

T = TypeVar("T")


def run_in_thread(work: Callable[[], T], name: str) -> asyncio.Future[T]:
    """Call ``work`` in a new daemon thread named ``lumiloop-`` and ``name``; the future carries its result or error.

    Raises:
        RuntimeError: the system cannot start another thread.
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
        with contextlib.suppress(RuntimeError):  # the loop has closed: the result is not needed
            loop.call_soon_threadsafe(end, settle)

    threading.Thread(target=run, name=f"lumiloop-{name}", daemon=True).start()
    return ended
