"""`lumiloop fleet fetch`: a robot takes the survey and the map that its fleet shares, once or whenever there are newer.

What is asked of the running daemon is asked by Modbus, as any client may (command SWITCH_MAP), and only with --switch.
"""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path
from typing import Final

import zenoh

from daemon.cli.status import address_of
from daemon.publish.modbus.client import NoAnswer
from daemon.system import console
from daemon.system.atomic_file import reason_of
from hal.run_server import run_until_stopped
from taps.fleet import messages
from taps.fleet.messages import SHARED, Unreadable, printable
from taps.fleet.placing import KINDS, MAP, Offer, Records, Refused, Taken, chosen, home, place, sha256_of
from taps.fleet.share import key_of
from taps.view.orders import OrderRefused, switch_map
from taps.zenoh_session import BadEndpoint, answers, joined, watched

CONTENT_S: Final = 60.0
"""A map may take so long to come."""
TRIES: Final = 3
PAUSE_S: Final = 1.0
AGAIN_S: Final = 300.0
"""So often it is looked for newer ones, whatever has been heard."""
RETRY_S: Final = 15.0
"""And so soon after something has not come."""


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    fetcher = Fetcher(args)
    try:
        asyncio.run(run_until_stopped(fetcher.run()) if args.follow else fetcher.run())
    except BadEndpoint as error:
        return console.fail(str(error), console.USAGE)
    except NoAnswer as error:
        return console.fail(f"--switch: {error}", console.USAGE)
    return console.FAILED if fetcher.failed else console.OK


class Fetcher:
    """Fetches what is asked for.

    Attributes:
        failed: whether something that was wanted did not come in the latest round.
    """

    def __init__(self, args: argparse.Namespace, records: Records | None = None) -> None:
        self.failed = False
        self._args, self._records = args, records or Records()
        self._kinds = [kind for kind in KINDS if kind in args.what] or list(KINDS)
        self._said: dict[str, str] = {}

    async def run(self) -> None:
        """Fetch once; or follow until cancelled.

        Raises:
            BadEndpoint: no such router can be. NoAnswer: the configuration has no Modbus to switch maps by.
        """
        args = self._args
        modbus = address_of(None, args.settings) if args.switch else None
        async with joined(args.router, args.zenoh) as session:
            if not args.follow:
                await self._round(session, modbus)
                return
            news = asyncio.Event()
            loop = asyncio.get_running_loop()
            session.liveliness().declare_subscriber(
                f"{SHARED}/alive/*", lambda sample: loop.call_soon_threadsafe(news.set), history=True
            )
            watching = asyncio.create_task(watched(session, args.router, lambda there: news.set()))
            try:
                while True:
                    news.clear()
                    await self._round(session, modbus)
                    try:
                        async with asyncio.timeout(RETRY_S if self.failed else AGAIN_S):
                            await news.wait()
                    except TimeoutError:
                        continue
            finally:
                watching.cancel()

    async def _round(self, session: zenoh.Session, modbus: tuple[str, int] | None) -> None:
        self.failed = False
        for kind in self._kinds:
            try:
                said = await self._fetch(session, kind, modbus)
            except Refused as error:
                said, self.failed = str(error), True
            if said != self._said.get(kind):
                self._said[kind] = said
                console.say(printable(said))  # who shares has chosen some of the words

    async def _fetch(self, session: zenoh.Session, kind: str, modbus: tuple[str, int] | None) -> str:
        """What came of it.

        Raises:
            Refused: nothing came, or it is not taken.
        """
        survey: Path | None = self._args.survey
        taken = self._records.taken().get(kind)
        if taken is not None and taken.kept_in() != home(kind, self._args.settings, survey):
            taken = None  # it has been deleted, or is wanted elsewhere now
        offer = chosen(kind, await self._offers(session, kind), taken)
        if offer is None:
            assert taken is not None
            said = f"{kind} version {taken.version} is here already"
            if kind == MAP and modbus is not None and not taken.switched:
                said = f"{said}; {await self._switch(modbus, taken)}"
            return said
        where, note = place(offer, await self._content(session, offer), self._args.settings, survey)
        try:
            taken = self._records.note(offer, where)
        except OSError as error:
            raise Refused(f"{self._records.path}: {reason_of(error)}; {where} is in place all the same") from None
        if kind == MAP and modbus is not None:
            try:
                note = await self._switch(modbus, taken)
            except Refused as error:
                raise Refused(f"{offer.said()} is in {where}; {error}") from None
        return f"{offer.said()} is in {where}; {note}"

    async def _switch(self, modbus: tuple[str, int], taken: Taken) -> str:
        """Have the daemon go on in the map, and note it: until then it is asked again at every call.

        Raises:
            Refused: it does not, or that cannot be noted.
        """
        await switched(self._args.settings.name, modbus, taken.map_id)
        try:
            self._records.switched(taken)
        except OSError as error:
            raise Refused(f"{self._records.path}: {reason_of(error)}; the daemon goes on in it all the same") from None
        return "the daemon goes on in it"

    async def _offers(self, session: zenoh.Session, kind: str) -> list[Offer]:
        """What is shared; who shares may just be coming back, as after a router's restart."""
        offers: list[Offer] = []
        for left in reversed(range(TRIES)):
            for _, content, _ in await answers(session, key_of(kind)):
                try:
                    offers.append(messages.read(content, Offer))
                except Unreadable as error:
                    console.say(printable(f"what is offered as {kind} is not one: {error}"))
            if offers or not left:
                break
            await asyncio.sleep(PAUSE_S)
        return offers

    async def _content(self, session: zenoh.Session, offer: Offer) -> bytes:
        for _ in range(TRIES):
            found = await answers(session, key_of(offer.kind, offer.sha256), CONTENT_S)
            for _, content, _ in found:
                if sha256_of(content) == offer.sha256:
                    return content
            if found:
                return found[0][1]  # which is refused, with what is wrong with it
        raise Refused(f"{offer.said()}: is announced, and does not come; is the connection to who shares it broken?")


async def switched(name: str, modbus: tuple[str, int], map_id: int) -> None:
    """Ask the daemon to go on in the map.

    Raises:
        Refused: it does not, or cannot be asked.
    """
    try:
        outcome = await switch_map(name, *modbus, map_id)
    except OrderRefused as error:
        raise Refused(f"the daemon could not be asked to go on in it: {error}") from None
    if outcome != "done":
        raise Refused(f"the daemon was asked to go on in it: {outcome}; its log says why")
