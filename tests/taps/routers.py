"""A Zenoh router for tests, which can be ended and begun again."""

import asyncio
import time
from argparse import Namespace
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from daemon.config.schema import Config
from taps.zenoh_session import session_config
from tools.sim.ports import free_port


class Router:
    """At an address that stays the same."""

    def __init__(self) -> None:
        self.address = f"127.0.0.1:{free_port()}"
        self._session: zenoh.Session | None = None
        self.begin()

    def begin(self) -> None:
        self._session = zenoh.open(session_config("router", self.address))

    def end(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None


@contextmanager
def router() -> Iterator[Router]:
    made = Router()
    try:
        yield made
    finally:
        made.end()


def told_to(made: Router, name: str = "agv", **more: Any) -> Namespace:
    """What the command line would say."""
    given = {"router": made.address, "zenoh": None, "settings": Config(name=name), "rate": 20.0}
    return Namespace(**{**given, **more})


class Heard:
    """What has been said to people so far; called with words: whether they are among it, so often."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys, self._said = capsys, ""

    def __call__(self, words: str, times: int = 1) -> bool:
        self._said += self._capsys.readouterr().err
        return self._said.count(words) >= times


async def until(what: Callable[[], Any], seconds: float = 10.0) -> Any:
    """Wait until something is true, and return it."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end, "it has not come about"
        await asyncio.sleep(0.02)
    return found


async def beside(body: Coroutine[Any, Any, None], *works: Coroutine[Any, Any, None]) -> None:
    """Do the body while others work; one of them that fails fails the test."""
    tasks = [asyncio.create_task(work) for work in works]
    main = asyncio.create_task(body)
    try:
        await asyncio.wait([main, *tasks], return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            if task.done():
                task.result()
        await main
    finally:
        for task in (main, *tasks):
            task.cancel()
        await asyncio.gather(main, *tasks, return_exceptions=True)
