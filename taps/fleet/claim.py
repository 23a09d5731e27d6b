"""Exclusive claim of a robot's name in the fleet: the first claimant publishes, others wait.

Claims are liveliness tokens, which the router removes with their session. After a network partition two claimants may
exist: the smallest token wins (`messages.instance_of`), the other one stops.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Final

import zenoh

from daemon.system import console
from taps.fleet import messages
from taps.zenoh_session import POLL_S, Say, list_tokens, undeclare

ALONE_S: Final = 5.0
"""A name is free after its claimant has been absent for this long with the router present: after a router restart some
sessions return later than others."""
SURE_S: Final = 1.0
"""Time after which two simultaneous claimants have seen each other; before it no claim is reported as successful."""


class Claim:
    """The claim of one name.

    Attributes:
        mine: whether this process holds it.

    Args:
        on_change: called in the loop's thread when the name is won or lost.
    """

    def __init__(
        self,
        session: zenoh.Session,
        robot: str,
        host: str,
        on_change: Callable[[bool], None],
        report: Say = console.say,
    ) -> None:
        self.mine = False
        self._session, self._robot, self._host, self._on_change, self._report = session, robot, host, on_change, report
        self._others: dict[str, bool] = {}  # whether it is present
        self._token: zenoh.LivelinessToken | None = None
        self._instance = ""
        self._subscriber: zenoh.Subscriber[None] | None = None
        self._reported = False  # that the claim succeeded
        self._alone = 0.0  # s since no other claimant had precedence, or since the last decision

    async def run(self) -> None:
        """Hold the name whenever no other process does, until cancelled."""
        try:
            await self._begin()
            while True:
                await asyncio.sleep(POLL_S)
                free = not self._before() and bool(self._session.info.routers_zid())
                self._alone = self._alone + POLL_S if free else 0.0
                if self.mine and not self._reported and self._alone >= SURE_S:
                    self._reported = True
                    self._report(f"{self._robot} is in the fleet")
                elif self._alone >= ALONE_S and not self.mine:
                    self._settle(True)
        finally:
            if self._subscriber is not None:
                undeclare(self._subscriber)
            self._put(None)

    async def _begin(self) -> None:
        """Declare the claim, after those already present, whatever their clocks."""
        everybody = messages.alive(self._robot, "*")
        loop = asyncio.get_running_loop()

        def on_token(sample: zenoh.Sample) -> None:
            present = sample.kind == zenoh.SampleKind.PUT
            instance = str(sample.key_expr).rpartition("/")[2]
            with contextlib.suppress(RuntimeError):  # the loop has closed
                loop.call_soon_threadsafe(self._on_claim, instance, present)

        # before the list is queried: a claimant that leaves meanwhile would stay in it
        self._subscriber = self._session.liveliness().declare_subscriber(everybody, on_token, history=True)
        for name in await list_tokens(self._session, everybody):
            self._others.setdefault(name.rpartition("/")[2], True)
        present = [one for one, is_present in self._others.items() if is_present]
        claimed = max([messages.now_ms(), *(messages.claimed_of(one) + 1 for one in present)])
        self._instance = messages.instance_of(str(self._session.info.zid()), self._host, claimed)
        self._settle(not self._before())

    def _on_claim(self, instance: str, present: bool) -> None:
        if instance == self._instance:
            return
        if present or not self._instance:  # the pending list must not restore a claimant that has left
            self._others[instance] = present
        else:
            self._others.pop(instance, None)
        if self.mine and self._before():
            self._settle(False)

    def _before(self) -> str:
        """The claimant with precedence over this one; empty: none."""
        first = min((one for one, present in self._others.items() if present), default="")
        return first if first and first < self._instance else ""

    def _settle(self, mine: bool) -> None:
        """Record that the name is won or lost."""
        self.mine, self._alone = mine, 0.0
        self._put(messages.alive if mine else messages.waiting)
        if not mine:
            self._reported = False
            self._report(
                f"the fleet has a robot {self._robot} already, on {messages.host_of(self._before())}; this "
                f"one, on {self._host}, publishes nothing until that one has left. Give one of them another "
                "`name`"
            )
        self._on_change(mine)

    def _put(self, place: Callable[[str, str], str] | None) -> None:
        """Replace the liveliness token; None: remove it."""
        old = self._token
        self._token = None
        if place is not None:
            self._token = self._session.liveliness().declare_token(place(self._robot, self._instance))
        if old is not None:
            undeclare(old)
