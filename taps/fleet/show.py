"""`lumiloop fleet`: all robots on one map, in the terminal, as JSON, or as a picture."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import shutil
import sys
import time
from threading import Lock
from typing import Final

import msgspec
import zenoh

from daemon.maps.png import encode_png
from daemon.system import console
from daemon.system.atomic_file import reason_of, write_whole
from hal.run_server import run_until_stopped
from taps.fleet import drawing, messages
from taps.fleet.roster import MOST_MAPS, MOST_ROBOTS, Roster
from taps.zenoh_session import BadEndpoint, answers, joined, parts, watched

ROUTER_S: Final = 10.0
"""For so long who asks once waits for the router."""
ONCE_S: Final = 2.0
"""Who tells at all has told by then."""
CLEAR: Final = "\x1b[H\x1b[2J"
EVERY: Final = f"{messages.ROOT}/*/*"
MOST_WAITING: Final = MOST_MAPS
"""Bytes of messages that are not looked at yet; what comes beyond them is left out."""
SMALLEST: Final = 1024
"""What a message takes besides."""
ASKED_AT_ONCE: Final = 8
"""Robots; each takes a thread until it has answered."""
MOST_ANSWERS: Final = 16
"""Of one robot, which has four topics."""


class NoRouter(Exception):
    """Who asks once has waited long enough; the text says so."""


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    roster = Roster()
    try:
        asyncio.run(run_until_stopped(show(args, roster), seconds=0.0) if args.watch else show(args, roster))
    except BadEndpoint as error:
        return console.fail(str(error), console.USAGE)
    except NoRouter as error:
        return console.fail(str(error))
    except OSError as error:
        return console.fail(f"{args.picture}: {reason_of(error)}; name another file")
    return console.OK if roster.members else console.fail(f"no robot tells anything by way of {args.router}")


async def show(args: argparse.Namespace, roster: Roster) -> None:
    """Listen, and show what is known: once, or every second until cancelled.

    Raises:
        BadEndpoint: no such router can be. NoRouter: none answers. OSError: the picture cannot be written.
    """
    async with contextlib.AsyncExitStack() as stack:
        try:
            async with asyncio.timeout(None if args.watch else ROUTER_S):
                session = await stack.enter_async_context(joined(args.router, args.zenoh))
        except TimeoutError:
            raise NoRouter(
                f"no router answers at {args.router} within {ROUTER_S:g} s: "
                "start one (`lumiloop fleet router`), or name it (--router)"
            ) from None
        listener = Listener(session, roster)
        watching = asyncio.create_task(watched(session, args.router, listener.on_router))
        try:
            await asyncio.sleep(ONCE_S)
            while True:
                text = told(args, roster, listener.there)
                sys.stdout.write((CLEAR if args.watch and sys.stdout.isatty() and not args.json else "") + text)
                sys.stdout.flush()
                if not args.watch:
                    return
                roster.forget(time.monotonic(), listener.there)
                await asyncio.sleep(1.0)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)


class Listener:
    """Keeps a roster of what is told.

    Attributes:
        there: whether the router is.
    """

    def __init__(self, session: zenoh.Session, roster: Roster) -> None:
        self.there = True
        self._session, self._roster = session, roster
        self._loop = asyncio.get_running_loop()
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._may_ask = asyncio.Semaphore(ASKED_AT_ONCE)
        self._waiting, self._lock = 0, Lock()
        # callbacks are the session's threads': the roster is touched in the loop's alone
        session.declare_subscriber(EVERY, self._heard)
        for kind in ("alive", "waiting"):
            session.liveliness().declare_subscriber(f"{messages.ROOT}/*/{kind}/*", self._token, history=True)

    def on_router(self, there: bool) -> None:
        """The router goes, or is back."""
        self.there = there
        if not there:
            self._roster.without_router()

    def _call(self, function: object, *args: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has closed: nobody looks any more
            self._loop.call_soon_threadsafe(function, *args)  # type: ignore[arg-type]  # both are ours

    def _heard(self, sample: zenoh.Sample) -> None:
        """Called by the session's threads, sooner than the loop can look at what comes, maybe."""
        size = len(sample.payload) + (0 if sample.attachment is None else len(sample.attachment)) + SMALLEST
        with self._lock:
            if self._waiting + size > MOST_WAITING:
                return
            self._waiting += size
        self._call(self._take, parts(sample), size)

    def _take(self, found: tuple[str, bytes, bytes], size: int) -> None:
        with self._lock:
            self._waiting -= size
        self._roster.take(*found, time.monotonic())

    def _token(self, sample: zenoh.Sample) -> None:
        self._call(self._on_token, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def _on_token(self, key: str, there: bool) -> None:
        robot = self._roster.token(key, there)
        if robot and robot not in self._asking and len(self._asking) < MOST_ROBOTS:
            self._asking[robot] = task = asyncio.create_task(self._ask(robot))
            task.add_done_callback(lambda _: self._asking.pop(robot))

    async def _ask(self, robot: str) -> None:
        """What it has told before we came."""
        async with self._may_ask:
            for found in await answers(self._session, messages.key(robot, "*"), most=MOST_ANSWERS):
                self._roster.take(*found, time.monotonic())


def told(args: argparse.Namespace, roster: Roster, there: bool) -> str:
    """What is known, for people or programs; the picture is written."""
    members, chart, now = roster.sorted(), roster.chart(), time.monotonic()
    if args.json:
        robots = {
            one.name: {"alive": bool(one.speakers), "age_s": now - one.t_heard, "pose": one.pose, "state": one.state}
            for one in members
        }
        return msgspec.json.encode({"router": there, "robots": robots, "problems": roster.problems()}).decode() + "\n"
    lines = drawing.table(members, now)
    if chart is not None:
        size = shutil.get_terminal_size((100, 50))
        lines = [*drawing.plan(chart, members, size.columns, max(10, size.lines - len(lines) - 6)), "", *lines]
        if args.picture is not None:
            pixels, said = drawing.picture(chart, members)
            write_whole(args.picture, encode_png(pixels))
            lines.append(f"{args.picture}: {', '.join(said) or 'no robot is in that map'}")
    elif args.picture is not None:
        lines.append(f"{args.picture}: not written, no robot has told a map yet")
    lines += [] if there else [f"the router at {args.router} has gone: this is what was told last"]
    return "\n".join([*lines, *roster.problems()]) + "\n"
