"""`lumiloop fleet`: shows all robots on one map, in the terminal, as JSON, or as an image."""

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
from taps.zenoh_session import BadEndpoint, open_session, query_all, sample_parts, watch_router

ROUTER_S: Final = 10.0
"""Wait for the router without --watch."""
ONCE_S: Final = 2.0
"""Time in which every publisher sends its messages."""
CLEAR: Final = "\x1b[H\x1b[2J"
EVERY: Final = f"{messages.ROOT}/*/*"
MOST_WAITING: Final = MOST_MAPS
"""Most bytes of unprocessed messages; further ones are dropped."""
SMALLEST: Final = 1024
"""Overhead of a message, bytes."""
MOST_QUERIES: Final = 8
"""Most simultaneous queries; each uses a thread."""
MOST_ANSWERS: Final = 16
"""Most replies of one robot, which has four topics."""


class NoRouter(Exception):
    """No router answered in time; the text gives a remedy."""


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
    return console.OK if roster.members else console.fail(f"no robot publishes through {args.router}")


async def show(args: argparse.Namespace, roster: Roster) -> None:
    """Collect messages and show the fleet: once, or every second until cancelled.

    Raises:
        BadEndpoint: invalid endpoint. NoRouter: none answers. OSError: the picture cannot be written.
    """
    async with contextlib.AsyncExitStack() as stack:
        try:
            async with asyncio.timeout(None if args.watch else ROUTER_S):
                session = await stack.enter_async_context(open_session(args.router, args.zenoh))
        except TimeoutError:
            raise NoRouter(
                f"no router answers at {args.router} within {ROUTER_S:g} s; start one with `lumiloop fleet "
                "router`, or name it with --router"
            ) from None
        collector = Collector(session, roster)
        watching = asyncio.create_task(watch_router(session, args.router, collector.on_router))
        try:
            await asyncio.sleep(ONCE_S)
            while True:
                text = render(args, roster, collector.present)
                sys.stdout.write((CLEAR if args.watch and sys.stdout.isatty() and not args.json else "") + text)
                sys.stdout.flush()
                if not args.watch:
                    return
                roster.drop_absent(time.monotonic(), collector.present)
                await asyncio.sleep(1.0)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)


class Collector:
    """Fills a roster from subscriptions and queries.

    Attributes:
        there: whether the router is present.
    """

    def __init__(self, session: zenoh.Session, roster: Roster) -> None:
        self.present = True
        self._session, self._roster = session, roster
        self._loop = asyncio.get_running_loop()
        self._queries: dict[str, asyncio.Task[None]] = {}
        self._slots = asyncio.Semaphore(MOST_QUERIES)
        self._waiting, self._lock = 0, Lock()
        # callbacks run in the session's threads; the roster is used in the loop's thread only
        session.declare_subscriber(EVERY, self._on_sample)
        for kind in ("alive", "waiting"):
            session.liveliness().declare_subscriber(f"{messages.ROOT}/*/{kind}/*", self._token, history=True)

    def on_router(self, present: bool) -> None:
        """Set the presence of the router."""
        self.present = present
        if not present:
            self._roster.without_router()

    def _call(self, function: object, *args: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has closed
            self._loop.call_soon_threadsafe(function, *args)  # type: ignore[arg-type]  # both are ours

    def _on_sample(self, sample: zenoh.Sample) -> None:
        """Queue a message; called by the session's threads, perhaps faster than the loop processes them."""
        size = len(sample.payload) + (0 if sample.attachment is None else len(sample.attachment)) + SMALLEST
        with self._lock:
            if self._waiting + size > MOST_WAITING:
                return
            self._waiting += size
        self._call(self._process, sample_parts(sample), size)

    def _process(self, found: tuple[str, bytes, bytes], size: int) -> None:
        with self._lock:
            self._waiting -= size
        self._roster.receive(*found, time.monotonic())

    def _token(self, sample: zenoh.Sample) -> None:
        self._call(self._on_token, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

    def _on_token(self, key: str, present: bool) -> None:
        robot = self._roster.token(key, present)
        if robot and robot not in self._queries and len(self._queries) < MOST_ROBOTS:
            self._queries[robot] = task = asyncio.create_task(self._query(robot))
            task.add_done_callback(lambda _: self._queries.pop(robot))

    async def _query(self, robot: str) -> None:
        """Query the messages that a robot published earlier."""
        async with self._slots:
            for found in await query_all(self._session, messages.key(robot, "*"), most=MOST_ANSWERS):
                self._roster.receive(*found, time.monotonic())


def render(args: argparse.Namespace, roster: Roster, present: bool) -> str:
    """Render the fleet as text or JSON, and write the picture."""
    members, chart, now = roster.sorted(), roster.chart(), time.monotonic()
    if args.json:
        robots = {
            one.name: {
                "alive": bool(one.publishers),
                "age_s": now - one.t_message,
                "pose": one.pose,
                "state": one.state,
            }
            for one in members
        }
        return msgspec.json.encode({"router": present, "robots": robots, "problems": roster.problems()}).decode() + "\n"
    lines = drawing.table(members, now)
    if chart is not None:
        size = shutil.get_terminal_size((100, 50))
        lines = [*drawing.plan(chart, members, size.columns, max(10, size.lines - len(lines) - 6)), "", *lines]
        if args.picture is not None:
            pixels, legend = drawing.picture(chart, members)
            write_whole(args.picture, encode_png(pixels))
            lines.append(f"{args.picture}: {', '.join(legend) or 'no robot is in that map'}")
    elif args.picture is not None:
        lines.append(f"{args.picture}: not written, because no robot has published a map yet")
    lines += [] if present else [f"the router at {args.router} is gone; these are the last received data"]
    return "\n".join([*lines, *roster.problems()]) + "\n"
