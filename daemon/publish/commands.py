"""Commands of clients, from Modbus and from the local command socket: dispatch and outcome.

A controller may repeat a command at any rate (it writes a new number in every program cycle). The log then contains
some of them and the count of the others.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from daemon.publish.feeds import Feeds
from daemon.publish.modbus.holding import CommandCode, Outcome, Request
from daemon.snapshot import Snapshot
from daemon.system.callbacks import OnDone
from daemon.system.logging import Sparing
from estimator import Command, Order
from hal.clock import Clock

log = logging.getLogger(__name__)


NO_RECORDER: Final = "the flight recorder is off; start the daemon with --record DIR --last MINUTES"
NO_MAPS: Final = "maps are not stored; set `map.folder`"
ASKED: Final = 8
"""Largest number of pending requests of one source, the latest ones: Modbus acknowledges only the last one."""
MODBUS: Final = "Modbus"

OnEnd = Callable[[Outcome, str], None]
"""Receives the outcome of a command, and the reason where it was refused (otherwise empty)."""


@dataclass(frozen=True, slots=True)
class _Asked:
    """Request whose cycle has yet to publish; ``placed``: it is done only when there is a pose."""

    on_end: OnEnd
    placed: bool


class Orders:
    """Dispatcher of client commands, the same for every source."""

    def __init__(self, clock: Clock, feeds: Feeds) -> None:
        self._clock = clock
        self._feeds = feeds
        self._asked: dict[str, deque[_Asked]] = {}
        self._lines = Sparing(log)

    def handle(self, request: Request, on_end: OnEnd, source: str = MODBUS) -> None:
        """Carry out a command; after any failure the client gets an outcome.

        ``source``: of the command, for the log. Pending commands are counted for each source apart.
        """
        self._lines.say(self._clock.now(), logging.INFO, f"{source}: {_said(request)}")
        on_done = partial(self._ended, request, on_end, source)
        try:
            self._hand_on(request, on_done, on_end, source)
        except Exception as failure:
            log.debug(
                "%s has failed", request.code.name, exc_info=True
            )  # debug only: at a client's rate it would fill the log
            on_done(f"the command has failed: {failure!r}")

    def _hand_on(self, request: Request, on_done: OnDone, on_end: OnEnd, source: str) -> None:
        feeds, code = self._feeds, request.code
        if code is CommandCode.SAVE_MAP:
            feeds.on_save(on_done)
        elif code is CommandCode.DUMP_RECORDER:
            on_done(NO_RECORDER) if feeds.on_dump is None else feeds.on_dump(on_done)
        elif code is CommandCode.SWITCH_MAP:
            on_done(NO_MAPS) if feeds.on_switch is None else feeds.on_switch(request.map_id, on_done)
        else:
            self._to_cycle(request, on_end, source)

    def _to_cycle(self, request: Request, on_end: OnEnd, source: str) -> None:
        """Put the command into the inbox of the next cycle."""
        order = Order[request.code.name]
        pose = np.array(request.pose) if order is Order.SET_POSE else None
        self._feeds.on_command(Command(self._clock.now(), order, pose))
        asked = self._asked.setdefault(source, deque(maxlen=ASKED))
        asked.append(_Asked(on_end, placed=order not in (Order.PAUSE, Order.RESUME)))

    def published(self, snapshot: Snapshot) -> None:
        """Sink of the cycle: report the commands that this cycle has carried out as done."""
        placed = snapshot.pose is not None
        for source, pending in self._asked.items():
            if pending:
                done = [asked for asked in pending if placed or not asked.placed]
                self._asked[source] = deque((asked for asked in pending if not placed and asked.placed), ASKED)
                for asked in done:
                    asked.on_end(Outcome.DONE, "")

    def _ended(self, request: Request, on_end: OnEnd, source: str, reason: str) -> None:
        if reason:
            self._lines.say(self._clock.now(), logging.WARNING, f"{source}: {request.code.name} refused: {reason}")
        on_end(Outcome.REFUSED if reason else Outcome.DONE, reason)


def _said(request: Request) -> str:
    """Text of a command with its parameters, for the log."""
    carried = {CommandCode.SET_POSE: f" {request.pose}", CommandCode.SWITCH_MAP: f" {request.map_id:08x}"}
    return request.code.name + carried.get(request.code, "")
