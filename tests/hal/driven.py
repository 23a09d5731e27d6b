"""What the benches of drivers share: a driver that runs for a while, and coroutine tests that a bench plays."""

import asyncio
import functools
import inspect
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any

import pytest


@asynccontextmanager
async def running(run: Coroutine[Any, Any, None]) -> AsyncGenerator[asyncio.Task[None]]:
    """A driver that runs inside an ``async with``, cancelled at its end; it neither ends before nor goes on."""
    task = asyncio.create_task(run)
    try:
        yield task
    finally:
        assert not task.done(), "the driver must never end by itself"
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task


def played(
    play: Callable[[Callable[[Any], Awaitable[None]]], object], name: str = "bench"
) -> Callable[..., Callable[..., None]]:
    """Make a test of a coroutine with an argument of that name, its bench: ``play`` runs it and passes the bench."""

    def made(body: Callable[..., Awaitable[None]]) -> Callable[..., None]:
        @functools.wraps(body)
        def test(*here: object, **given: object) -> None:
            play(lambda bench: body(*here, **{name: bench}, **given))

        arguments = inspect.signature(body).parameters.values()
        test.__signature__ = inspect.Signature([one for one in arguments if one.name != name])  # type: ignore[attr-defined]  # what pytest reads
        return test

    return made
