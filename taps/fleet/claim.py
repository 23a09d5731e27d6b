"""A robot's name in the fleet belongs to one speaker: the one who took it first. Others wait, and say so.

Speakers are liveliness tokens; the router takes away those of who has gone. After a partition two may have spoken for a
name: the least token has the word then (`messages.instance_of`), the other one stops.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Final

import zenoh

from daemon.system import console
from taps.fleet import messages
from taps.zenoh_session import BEAT_S, Say, listed, withdraw

ALONE_S: Final = 5.0
"""A name is taken from nobody before its speaker has been gone for so long, with the router there: after a router's
death some are back later than others."""
SURE_S: Final = 1.0
"""Two that join at once, or whose router has just come back, have heard of each other by then: before that none of them
is said to be in the fleet."""


class Claim:
    """A name that is wanted.

    Attributes:
        mine: whether it is ours now.

    Args:
        on_change: told when it becomes ours, and when it no longer is; in the loop's thread.
    """

    def __init__(
        self, session: zenoh.Session, robot: str, host: str, on_change: Callable[[bool], None], say: Say = console.say
    ) -> None:
        self.mine = False
        self._session, self._robot, self._host, self._on_change, self._say = session, robot, host, on_change, say
        self._others: dict[str, bool] = {}  # whether it is there, as heard last
        self._token: zenoh.LivelinessToken | None = None
        self._instance = ""
        self._listening: zenoh.Subscriber[None] | None = None
        self._said = False  # that it is ours
        self._alone = 0.0  # s since when nobody has it before us, or since it was settled whose it is

    async def run(self) -> None:
        """Have the name whenever nobody else has it, until cancelled."""
        try:
            await self._begin()
            while True:
                await asyncio.sleep(BEAT_S)
                free = not self._before() and bool(self._session.info.routers_zid())
                self._alone = self._alone + BEAT_S if free else 0.0
                if self.mine and not self._said and self._alone >= SURE_S:
                    self._said = True
                    self._say(f"{self._robot} is in the fleet")
                elif self._alone >= ALONE_S and not self.mine:
                    self._settle(True)
        finally:
            if self._listening is not None:
                withdraw(self._listening)
            self._put(None)

    async def _begin(self) -> None:
        """Who is there already is before us, whatever clocks say."""
        everybody = messages.alive(self._robot, "*")
        loop = asyncio.get_running_loop()

        def heard(sample: zenoh.Sample) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            instance = str(sample.key_expr).rpartition("/")[2]
            with contextlib.suppress(RuntimeError):  # the loop has closed: nobody claims it any more
                loop.call_soon_threadsafe(self._heard, instance, there)

        # before the list is asked for: who leaves in the meantime would be in it for ever
        self._listening = self._session.liveliness().declare_subscriber(everybody, heard, history=True)
        for name in await listed(self._session, everybody):
            self._others.setdefault(name.rpartition("/")[2], True)
        there = [one for one, is_there in self._others.items() if is_there]
        claimed = max([messages.now_ms(), *(messages.claimed_of(one) + 1 for one in there)])
        self._instance = messages.instance_of(str(self._session.info.zid()), self._host, claimed)
        self._settle(not self._before())

    def _heard(self, instance: str, there: bool) -> None:
        if instance == self._instance:
            return
        if there or not self._instance:  # while the list is awaited, who has gone must not come back by it
            self._others[instance] = there
        else:
            self._others.pop(instance, None)
        if self.mine and self._before():
            self._settle(False)

    def _before(self) -> str:
        """Who has the name before us; empty: nobody."""
        first = min((one for one, there in self._others.items() if there), default="")
        return first if first and first < self._instance else ""

    def _settle(self, mine: bool) -> None:
        """The name is ours from now on, or is not."""
        self.mine, self._alone = mine, 0.0
        self._put(messages.alive if mine else messages.waiting)
        if not mine:
            self._said = False
            self._say(
                f"the fleet has a robot {self._robot} already, on {messages.host_of(self._before())}; this one, on "
                f"{self._host}, tells nothing until that one has gone: give one of them another `name`"
            )
        self._on_change(mine)

    def _put(self, place: Callable[[str, str], str] | None) -> None:
        """The token that says how it is."""
        old = self._token
        self._token = None
        if place is not None:
            self._token = self._session.liveliness().declare_token(place(self._robot, self._instance))
        if old is not None:
            withdraw(old)
