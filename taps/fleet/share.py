"""`lumiloop fleet share`: offers a survey and a map to all robots. `lumiloop fleet router`: runs a Zenoh router."""

from __future__ import annotations

import argparse
import asyncio
import socket

import zenoh

from daemon.system import console
from hal.run_server import run_until_stopped, until_stopped
from taps.fleet import messages
from taps.fleet.messages import SHARED, encode
from taps.fleet.placing import MAP, SURVEY, Offer, Refused, offer_of
from taps.zenoh_session import BadEndpoint, error_text, open_session, session_config, undeclare, watch_router


def main(args: argparse.Namespace) -> int:
    """Share until stopped; returns the exit code."""
    requested = [(kind, path) for kind, path in ((SURVEY, args.survey), (MAP, args.map)) if path is not None]
    if not requested:
        return console.fail("nothing to share is named; give --survey FILE or --map FILE", console.USAGE)
    try:
        offers = [offer_of(kind, path, args.version) for kind, path in requested]
        asyncio.run(run_until_stopped(share(args, offers)))
    except Refused as error:
        return console.fail(str(error))
    except BadEndpoint as error:
        return console.fail(str(error), console.USAGE)
    return console.OK


async def share(args: argparse.Namespace, offers: list[tuple[Offer, bytes]]) -> None:
    """Serve the offers until cancelled.

    Raises:
        BadEndpoint: invalid endpoint.
    """
    contents: dict[str, bytes] = {}
    for offer, content in offers:
        contents[key_of(offer.kind)] = encode(offer)
        contents[key_of(offer.kind, offer.sha256)] = content

    def answer(query: zenoh.Query) -> None:
        with query:
            for key, content in contents.items():
                if query.key_expr.intersects(key):
                    query.reply(key, content)

    async with open_session(args.router, args.zenoh) as session:
        session.declare_queryable(f"{SHARED}/**", answer)
        instance = messages.instance_of(str(session.info.zid()), socket.gethostname(), messages.now_ms())
        token = session.liveliness().declare_token(f"{SHARED}/alive/{instance}")  # robots query when it appears
        try:
            for offer, _ in offers:
                console.say(f"{offer.label()}, {offer.size} bytes, SHA-256 {offer.sha256}")
            await watch_router(session, args.router, lambda present: None)
        finally:
            undeclare(token)  # keeps a reference: the library undeclares unreferenced tokens


def key_of(kind: str, sha256: str = "") -> str:
    """Zenoh key of an offer, or of its content."""
    return f"{SHARED}/{kind}/{sha256}" if sha256 else f"{SHARED}/{kind}"


def router(args: argparse.Namespace) -> int:
    """Run a router until stopped; returns the exit code."""
    try:
        with zenoh.open(session_config("router", args.listen, args.zenoh)):
            console.say(f"router at {args.listen}")
            asyncio.run(until_stopped())
    except BadEndpoint as error:
        return console.fail(str(error), console.USAGE)
    except zenoh.ZError as error:
        return console.fail(
            f"cannot listen on {args.listen}: {error_text(error)}; free the address, or name another with --listen"
        )
    return console.OK
