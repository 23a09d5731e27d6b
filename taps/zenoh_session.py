"""Sessions with a Zenoh router: one that is away is waited for, said once, and come back to.

Sessions are clients: everything passes through the router, nothing listens on the robot, and what was declared is
declared again when the router is back. Calls that wait for the network are made in threads for which nobody waits at
a stop.
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
"""Who has been silent for so long is gone, for the other side; who does not answer so long is not there."""
MOST_BYTES: Final = 257 << 20
"""No message is larger: the largest map that a fleet shares, and its key. Zenoh's own limit is four times that."""
PROTOCOLS: Final = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream", "unixpipe", "serial", "vsock")
RETRY_S: Final = 1.0
CLOSE_S: Final = 2.0
BEAT_S: Final = 0.5
ASK_S: Final = 3.0
"""A question to others is answered by then, or not at all."""

Say = Callable[[str], None]
OnRouter = Callable[[bool], None]


class BadEndpoint(Exception):
    """No session can ever be made so; the text says why and what to write."""


def locator(text: str) -> str:
    """Zenoh's name of an endpoint: ``HOST:PORT`` is TCP, anything with a slash is Zenoh's own, as in ``tls/host:7447``.

    Raises:
        BadEndpoint: it is neither.
    """
    if "/" in text:
        if (protocol := text.partition("/")[0]) not in PROTOCOLS:
            raise BadEndpoint(f"{text}: {protocol!r} is no protocol; there are {', '.join(PROTOCOLS)}")
        return text
    try:
        host, port = parse_endpoint(text)
    except ValueError as error:
        raise BadEndpoint(f"{error}; or name one as Zenoh does, tls/HOST:PORT") from None
    return f"tcp/{in_url(host)}:{port}"


def config(mode: str, endpoint: str, file: Path | None = None) -> zenoh.Config:
    """What a session is opened with.

    Args:
        mode: client or router.
        endpoint: that a client connects to, that a router listens at.
        file: of Zenoh's own configuration, for certificates and rights; what is said here counts more.

    Raises:
        BadEndpoint: the endpoint or the file is not one.
    """
    side = "connect" if mode == "client" else "listen"
    try:
        made = zenoh.Config() if file is None else zenoh.Config.from_file(file)
        for key, value in {
            "mode": mode,
            f"{side}/endpoints": [locator(endpoint)],
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,  # needs rights that a service does without
            "timestamping/enabled": True,  # the caches for those who come late need it
            "transport/link/rx/max_message_size": MOST_BYTES,
            "transport/link/tx/lease": round(1e3 * LEASE_S),
            "transport/unicast/open_timeout": round(1e3 * LEASE_S),
        }.items():
            made.insert_json5(key, json.dumps(value))
        _check_files(made)
    except zenoh.ZError as error:
        raise BadEndpoint(f"{endpoint if file is None else f'{endpoint}, {file}'}: {words(error)}") from None
    return made


def _check_files(made: zenoh.Config) -> None:
    """Whether certificates and keys are there and are such: of those, Zenoh says only that it cannot connect.

    Raises:
        BadEndpoint: one is not.
    """
    for key, path in json.loads(made.get_json("transport/link/tls")).items():
        if isinstance(path, str) and key.endswith(("certificate", "private_key")):
            try:
                content = Path(path).read_bytes()
            except OSError as error:
                raise BadEndpoint(f"{path} ({key}): cannot be read: {error.strerror}") from None
            if b"-----BEGIN " not in content:
                raise BadEndpoint(f"{path} ({key}): no certificate or key in PEM form")


def words(error: Exception) -> str:
    """What a library's error says, without where in its sources."""
    told = re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error))
    message = re.search(r'msg: "(.*?)(?:"|$)', told)
    return (message[1] if message else told).strip().rstrip(".!")


@contextlib.asynccontextmanager
async def joined(router: str, file: Path | None = None, say: Say = console.say) -> AsyncIterator[zenoh.Session]:
    """A session with a router, as soon as there is one.

    Raises:
        BadEndpoint: there can be none.
    """
    made = config("client", router, file)
    said = False
    while True:
        try:
            session = await run_in_thread(partial(zenoh.open, made), "zenoh")
            break
        except zenoh.ZError as error:
            if not said:
                say(f"no Zenoh router answers at {router}; waiting for it ({words(error)})")
                said = True
            await asyncio.sleep(RETRY_S)
    if said:
        say(f"the router at {router} is there")
    try:
        yield session
    finally:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await run_in_thread(session.close, "zenoh")


async def watched(session: zenoh.Session, router: str, on_router: OnRouter, say: Say = console.say) -> None:
    """Say when the router goes and when it is back, until cancelled; ``on_router`` is told, and at first."""
    there = True
    on_router(True)
    while True:
        await asyncio.sleep(BEAT_S)
        if bool(session.info.routers_zid()) == there:
            continue
        there = not there
        say(f"the router at {router} is back" if there else f"the router at {router} has gone; waiting for it")
        on_router(there)


async def listed(session: zenoh.Session, key: str) -> list[str]:
    """Liveliness tokens that there are."""
    replies = await run_in_thread(lambda: list(session.liveliness().get(key, timeout=ASK_S)), "zenoh")
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


async def answers(
    session: zenoh.Session, key: str, seconds: float = ASK_S, most: int | None = None
) -> list[tuple[str, bytes, bytes]]:
    """What everybody answers who is asked, the first ``most`` of it: key, content, attachment."""

    def ask() -> list[tuple[str, bytes, bytes]]:
        replies = session.get(
            key, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=seconds
        )
        return [parts(reply.ok) for reply in islice(replies, most) if reply.ok is not None]

    return await run_in_thread(ask, "zenoh")


class Declared(Protocol):
    """A token, publisher, subscriber or queryable."""

    def undeclare(self) -> Any:  # the library's are not typed
        """Be no more."""


def withdraw(*declared: Declared) -> None:
    """Undeclare these."""
    for one in declared:
        one.undeclare()


def parts(sample: zenoh.Sample) -> tuple[str, bytes, bytes]:
    """Key, content, attachment."""
    attachment = sample.attachment
    return str(sample.key_expr), bytes(sample.payload), b"" if attachment is None else bytes(attachment)
