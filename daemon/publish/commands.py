"""Commands from Modbus: dispatches each to its handler and returns its outcome to the client.

A controller may repeat a command at any rate (it writes a new number in every program cycle). The log then contains
some of them and the count of the others.
"""

from __future__ import annotations

import logging
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


NO_RECORDER: Final = "this run keeps no flight recorder: start it with --record DIR --last MINUTES"
NO_MAPS: Final = "this run stores no maps: set map.folder"
ASKED: Final = 8
"""Largest number of pending requests, the latest ones: the acknowledge register holds only the last one of a client."""


@dataclass(slots=True)
class _Asked:
    """Request whose cycle has yet to publish; ``placed``: it is done only when there is a pose."""

    number: int
    placed: bool


class Orders:
    """Dispatcher of client commands.

    Args:
        acknowledge: reports the outcome of a request to the client.
    """

    def __init__(self, clock: Clock, feeds: Feeds, acknowledge: Callable[[int, Outcome], None]) -> None:
        self._clock = clock
        self._feeds = feeds
        self._acknowledge = acknowledge
        self._asked: list[_Asked] = []
        self._lines = Sparing(log)

    def handle(self, request: Request) -> None:
        """Carry out a written command; after any failure the client gets an outcome."""
        self._lines.say(self._clock.now(), logging.INFO, f"Modbus: {_said(request)}")
        on_done = partial(self._ended, request)
        try:
            self._hand_on(request, on_done)
        except Exception as failure:
            log.debug(
                "%s has failed", request.code.name, exc_info=True
            )  # debug only: at a client's rate it would fill the log
            on_done(f"it has failed: {failure!r}")

    def _hand_on(self, request: Request, on_done: OnDone) -> None:
        feeds, code = self._feeds, request.code
        if code is CommandCode.SAVE_MAP:
            feeds.on_save(on_done)
        elif code is CommandCode.DUMP_RECORDER:
            on_done(NO_RECORDER) if feeds.on_dump is None else feeds.on_dump(on_done)
        elif code is CommandCode.SWITCH_MAP:
            on_done(NO_MAPS) if feeds.on_switch is None else feeds.on_switch(request.map_id, on_done)
        else:
            self._to_cycle(request)

    def _to_cycle(self, request: Request) -> None:
        """Put the command into the inbox of the next cycle."""
        order = Order[request.code.name]
        pose = np.array(request.pose) if order is Order.SET_POSE else None
        self._feeds.on_command(Command(self._clock.now(), order, pose))
        asked = _Asked(request.number, placed=order not in (Order.PAUSE, Order.RESUME))
        self._asked = [*self._asked, asked][-ASKED:]

    def published(self, snapshot: Snapshot) -> None:
        """Sink of the cycle: report the commands that this cycle has carried out as done."""
        if self._asked:
            placed = snapshot.pose is not None
            done = [asked for asked in self._asked if placed or not asked.placed]
            self._asked = [asked for asked in self._asked if not placed and asked.placed]
            for asked in done:
                self._acknowledge(asked.number, Outcome.DONE)

    def _ended(self, request: Request, reason: str) -> None:
        if reason:
            self._lines.say(self._clock.now(), logging.WARNING, f"Modbus: {request.code.name} refused: {reason}")
        self._acknowledge(request.number, Outcome.REFUSED if reason else Outcome.DONE)


def _said(request: Request) -> str:
    """Text of a command with its parameters, for the log."""
    carried = {CommandCode.SET_POSE: f" {request.pose}", CommandCode.SWITCH_MAP: f" {request.map_id:08x}"}
    return request.code.name + carried.get(request.code, "")
