"""`lumiloop fleet fetch`: installs the survey and the map that the fleet shares, once or for every newer version.

Only with --switch is the running daemon switched to the map, by the Modbus command SWITCH_MAP.
"""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path
from typing import Final

import zenoh

from daemon.cli.status import address_of
from daemon.publish.modbus.client import NoAnswer
from daemon.publish.modbus.command_client import CommandRefused, switch_map
from daemon.system import console
from daemon.system.atomic_file import reason_of
from hal.run_server import run_until_stopped
from taps.fleet import messages
from taps.fleet.messages import SHARED, Unreadable, printable
from taps.fleet.placing import (
    KINDS,
    MAP,
    Installed,
    Offer,
    Records,
    Refused,
    install,
    newest_offer,
    sha256_of,
    target_path,
)
from taps.fleet.share import key_of
from taps.zenoh_session import BadEndpoint, open_session, query_all, watch_router

CONTENT_S: Final = 60.0
"""Time limit of the transfer of a map."""
TRIES: Final = 3
PAUSE_S: Final = 1.0
AGAIN_S: Final = 300.0
"""Period of checks for newer versions, besides those by notification."""
RETRY_S: Final = 15.0
"""Time to the next check after a failure."""


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
    """Fetches and installs the requested kinds.

    Attributes:
        failed: whether the latest round failed for any kind.
    """

    def __init__(self, args: argparse.Namespace, records: Records | None = None) -> None:
        self.failed = False
        self._args, self._records = args, records or Records()
        self._kinds = [kind for kind in KINDS if kind in args.what] or list(KINDS)
        self._reported: dict[str, str] = {}

    async def run(self) -> None:
        """Fetch once; or follow until cancelled.

        Raises:
            BadEndpoint: invalid endpoint. NoAnswer: the configuration has no Modbus for --switch.
        """
        args = self._args
        modbus = address_of(None, args.settings) if args.switch else None
        async with open_session(args.router, args.zenoh) as session:
            if not args.follow:
                await self._round(session, modbus)
                return
            news = asyncio.Event()
            loop = asyncio.get_running_loop()
            session.liveliness().declare_subscriber(
                f"{SHARED}/alive/*", lambda sample: loop.call_soon_threadsafe(news.set), history=True
            )
            watching = asyncio.create_task(watch_router(session, args.router, lambda present: news.set()))
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
                result = await self._fetch(session, kind, modbus)
            except Refused as error:
                result, self.failed = str(error), True
            if result != self._reported.get(kind):
                self._reported[kind] = result
                console.say(printable(result))  # it contains text of the sharing host

    async def _fetch(self, session: zenoh.Session, kind: str, modbus: tuple[str, int] | None) -> str:
        """Fetch and install one kind; returns the result as text.

        Raises:
            Refused: nothing was received, or it was not accepted.
        """
        survey: Path | None = self._args.survey
        taken = self._records.taken().get(kind)
        if taken is not None and taken.kept_in() != target_path(kind, self._args.settings, survey):
            taken = None  # deleted, or the target path has changed
        offer = newest_offer(kind, await self._offers(session, kind), taken)
        if offer is None:
            assert taken is not None
            result = f"{kind} version {taken.version} is installed already"
            if kind == MAP and modbus is not None and not taken.switched:
                result = f"{result}; {await self._switch(modbus, taken)}"
            return result
        where, note = install(offer, await self._content(session, offer), self._args.settings, survey)
        try:
            taken = self._records.note(offer, where)
        except OSError as error:
            raise Refused(f"{self._records.path}: {reason_of(error)}; {where} is installed nevertheless") from None
        if kind == MAP and modbus is not None:
            try:
                note = await self._switch(modbus, taken)
            except Refused as error:
                raise Refused(f"{offer.label()} is in {where}; {error}") from None
        return f"{offer.label()} is in {where}; {note}"

    async def _switch(self, modbus: tuple[str, int], taken: Installed) -> str:
        """Switch the daemon to the map and record it; until recorded, every call repeats the command.

        Raises:
            Refused: the daemon refuses, or the record cannot be written.
        """
        await switched(self._args.settings.name, modbus, taken.map_id)
        try:
            self._records.switched(taken)
        except OSError as error:
            raise Refused(f"{self._records.path}: {reason_of(error)}; the daemon uses the map nevertheless") from None
        return "the daemon uses the map now"

    async def _offers(self, session: zenoh.Session, kind: str) -> list[Offer]:
        """The present offers; tried again for a sharing host that is reconnecting."""
        offers: list[Offer] = []
        for left in reversed(range(TRIES)):
            for _, content, _ in await query_all(session, key_of(kind)):
                try:
                    offers.append(messages.read(content, Offer))
                except Unreadable as error:
                    console.say(printable(f"the shared {kind} is not valid: {error}"))
            if offers or not left:
                break
            await asyncio.sleep(PAUSE_S)
        return offers

    async def _content(self, session: zenoh.Session, offer: Offer) -> bytes:
        for _ in range(TRIES):
            found = await query_all(session, key_of(offer.kind, offer.sha256), CONTENT_S)
            for _, content, _ in found:
                if sha256_of(content) == offer.sha256:
                    return content
            if found:
                return found[0][1]  # refused later, with the reason
        raise Refused(f"{offer.label()}: the content does not arrive; check the connection to the robot that shares it")


async def switched(name: str, modbus: tuple[str, int], map_id: int) -> None:
    """Switch the daemon to the map.

    Raises:
        Refused: the daemon refuses, or does not answer.
    """
    try:
        outcome = await switch_map(name, *modbus, map_id)
    except CommandRefused as error:
        raise Refused(f"the daemon could not be commanded to use the map: {error}") from None
    if outcome != "done":
        raise Refused(f"the daemon did not switch to the map: {outcome}; its log gives the cause")
