"""Component supervisor: restarts a failed component with back-off, and logs its failure and recovery once."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from random import Random
from typing import Final

from hal.errors import HalError

log = logging.getLogger(__name__)

FIRST_S: Final = 0.5
LONGEST_S: Final = 30.0
STEADY_S: Final = 60.0
"""Run time in s after which a component counts as healthy: its next failure starts the back-off again."""


@dataclass(slots=True)
class Supervisor:
    """Runs components and lists those that are down.

    Attributes:
        failed: names of the components that are down at present. restarts: failures so far, by name.
        random: source of the jitter, which keeps the retries of several components apart.
    """

    failed: set[str] = field(default_factory=set)
    restarts: Counter[str] = field(default_factory=Counter)
    random: Random = field(default_factory=Random)

    async def keep(self, name: str, run: Callable[[], Awaitable[None]]) -> None:
        """Run a component for ever. Returns if it ends by itself (a log's end); a cancelled one is not restarted.

        A device error is logged in one line. Any other exception is a defect and is logged with its traceback, once
        until the component works again or fails in another way. The component is restarted in both cases: one broken
        publisher must not stop the pose for the others.
        """
        loop = asyncio.get_running_loop()
        pause, said = FIRST_S, ""
        while True:
            begun = loop.time()
            try:
                await self._run(name, run, begun)
            except HalError as error:
                self._lost(name, f"{name}: {error}")
            except Exception as error:
                if name not in self.failed or repr(error) != said:
                    log.exception("component %s has failed; the daemon restarts it until it works", name)
                said = repr(error)
                self._lost(name, "")
            else:
                self.failed.discard(name)
                return
            pause = FIRST_S if loop.time() - begun > STEADY_S else pause
            await asyncio.sleep(pause * self.random.uniform(0.75, 1.25))
            pause = min(LONGEST_S, 2.0 * pause)

    async def _run(self, name: str, run: Callable[[], Awaitable[None]], begun: float) -> None:
        """Run the component once; it counts as recovered if it still runs after the first back-off."""
        loop = asyncio.get_running_loop()
        returned = loop.call_at(begun + FIRST_S, self._returned, name)
        try:
            await run()
        finally:
            returned.cancel()

    def _lost(self, name: str, line: str) -> None:
        self.restarts[name] += 1
        if line and name not in self.failed:
            log.warning("%s; the daemon tries again until it works", line)
        self.failed.add(name)

    def _returned(self, name: str) -> None:
        if name in self.failed:
            self.failed.discard(name)
            log.info("%s works again", name)
