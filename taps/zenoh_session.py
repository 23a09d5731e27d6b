"""Sessions with a Zenoh router: connect, wait for an absent router, reconnect, query.

Sessions are clients: all data pass through the router, nothing listens on the robot, and Zenoh repeats all declarations
after a reconnect. Blocking calls run in daemon threads, which do not delay a stop.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Final, Protocol

import zenoh

from daemon.config.endpoints import in_url, parse_endpoint
from daemon.system import console
from hal.blocking_calls import run_in_thread

LEASE_S: Final = 5.0
"""Lease: a peer that is silent for this long counts as gone; a connection attempt times out after it."""
MOST_BYTES: Final = 257 << 20
"""Largest message: the largest map that a fleet shares, with its key. Zenoh's own limit is four times that."""
PROTOCOLS: Final = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream", "unixpipe", "serial", "vsock")
RETRY_S: Final = 1.0
CLOSE_S: Final = 2.0
POLL_S: Final = 0.5
QUERY_S: Final = 3.0
"""Time limit of a query."""

Say = Callable[[str], None]
OnRouter = Callable[[bool], None]


class BadEndpoint(Exception):
    """An unusable endpoint or configuration; the text gives the cause and a remedy."""


def locator(text: str) -> str:
    """Zenoh's name of an endpoint: ``HOST:PORT`` is TCP, anything with a slash is Zenoh's own, as in ``tls/host:7447``.

    Raises:
        BadEndpoint: neither form.
    """
    if "/" in text:
        if (protocol := text.partition("/")[0]) not in PROTOCOLS:
            raise BadEndpoint(f"{text}: {protocol!r} is not a protocol; available: {', '.join(PROTOCOLS)}")
        return text
    try:
        host, port = parse_endpoint(text)
    except ValueError as error:
        raise BadEndpoint(f"{error}; or give an address in Zenoh's form, tls/HOST:PORT") from None
    return f"tcp/{in_url(host)}:{port}"


def session_config(mode: str, endpoint: str, file: Path | None = None) -> zenoh.Config:
    """The Zenoh configuration of a session.

    Args:
        mode: client or router.
        endpoint: to which a client connects, or at which a router listens.
        file: Zenoh's own configuration, for certificates and access rights; the values of this function override it.

    Raises:
        BadEndpoint: an invalid endpoint or file.
    """
    side = "connect" if mode == "client" else "listen"
    try:
        result = zenoh.Config() if file is None else zenoh.Config.from_file(file)
        for key, value in {
            "mode": mode,
            f"{side}/endpoints": [locator(endpoint)],
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,  # needs rights that the service lacks
            "timestamping/enabled": True,  # needed by the caches for late joiners
            "transport/link/rx/max_message_size": MOST_BYTES,
            "transport/link/tx/lease": round(1e3 * LEASE_S),
            "transport/unicast/open_timeout": round(1e3 * LEASE_S),
        }.items():
            result.insert_json5(key, json.dumps(value))
        _check_files(result)
    except zenoh.ZError as error:
        raise BadEndpoint(f"{endpoint if file is None else f'{endpoint}, {file}'}: {error_text(error)}") from None
    return result


def _check_files(result: zenoh.Config) -> None:
    """Check that certificates and keys exist and are PEM: Zenoh reports only a failed connection.

    Raises:
        BadEndpoint: one is missing or invalid.
    """
    for key, path in json.loads(result.get_json("transport/link/tls")).items():
        if isinstance(path, str) and key.endswith(("certificate", "private_key")):
            try:
                content = Path(path).read_bytes()
            except OSError as error:
                raise BadEndpoint(f"{path} ({key}): cannot be read: {error.strerror}") from None
            if b"-----BEGIN " not in content:
                raise BadEndpoint(f"{path} ({key}): the file has no certificate or key in PEM form")


def error_text(error: Exception) -> str:
    """Message of a Zenoh error, without the position in its sources."""
    text = re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error))
    message = re.search(r'msg: "(.*?)(?:"|$)', text)
    return (message[1] if message else text).strip().rstrip(".!")


@contextlib.asynccontextmanager
async def open_session(router: str, file: Path | None = None, say: Say = console.say) -> AsyncIterator[zenoh.Session]:
    """A client session with a router; waits until the router answers.

    Raises:
        BadEndpoint: an invalid endpoint or file.
    """
    result = session_config("client", router, file)
    reported = False
    while True:
        try:
            session = await run_in_thread(partial(zenoh.open, result), "zenoh")
            break
        except zenoh.ZError as error:
            if not reported:
                say(f"no Zenoh router answers at {router}; waiting for it ({error_text(error)})")
                reported = True
            await asyncio.sleep(RETRY_S)
    if reported:
        say(f"connected to the router at {router}")
    try:
        yield session
    finally:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await run_in_thread(session.close, "zenoh")


async def watch_router(session: zenoh.Session, router: str, on_router: OnRouter, say: Say = console.say) -> None:
    """Report loss and return of the router until cancelled; ``on_router`` receives its presence, also at the start."""
    present = True
    on_router(True)
    while True:
        await asyncio.sleep(POLL_S)
        if bool(session.info.routers_zid()) == present:
            continue
        present = not present
        say(
            f"connected to the router at {router} again"
            if present
            else f"the connection to the router at {router} is lost; waiting for it"
        )
        on_router(present)


async def list_tokens(session: zenoh.Session, key: str) -> list[str]:
    """Keys of the present liveliness tokens."""
    replies = await run_in_thread(lambda: list(session.liveliness().get(key, timeout=QUERY_S)), "zenoh")
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


async def query_all(
    session: zenoh.Session, key: str, seconds: float = QUERY_S, most: int | None = None
) -> list[tuple[str, bytes, bytes]]:
    """The first ``most`` replies of all queryables: key, content, attachment."""

    def get() -> list[tuple[str, bytes, bytes]]:
        replies = session.get(
            key, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=seconds
        )
        return [sample_parts(reply.ok) for reply in islice(replies, most) if reply.ok is not None]

    return await run_in_thread(get, "zenoh")


class Declared(Protocol):
    """A token, publisher, subscriber or queryable."""

    def undeclare(self) -> Any:  # the library's are not typed
        """End the declaration."""


def undeclare(*declared: Declared) -> None:
    """Undeclare these."""
    for one in declared:
        one.undeclare()


def sample_parts(sample: zenoh.Sample) -> tuple[str, bytes, bytes]:
    """Key, content, attachment."""
    attachment = sample.attachment
    return str(sample.key_expr), bytes(sample.payload), b"" if attachment is None else bytes(attachment)
