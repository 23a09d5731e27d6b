"""Session of one client of the local stream: its topics, its queue, and when it is disconnected.

For a slow client, a newer message of a state-like topic replaces the pending one (and is counted); events are queued
for it, up to a limit.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from collections import deque
from collections.abc import Mapping
from typing import Any, Final, Protocol

import msgspec

from daemon.maps.tiles import NOTHING_SHOWN
from hal.net.fair_share import Share
from hal.net.peers import most_of

log = logging.getLogger(__name__)

SCHEMA: Final = 1
"""Version of all messages. A field never changes its meaning under the same number; readers skip unknown ones."""

LATEST: Final = {
    "pose": "after each cycle: the snapshot, with the meaning of the state",
    "lights": "after each cycle: the light solution, with every link",
    "scan": "each scan: ranges in m as little-endian float32; inf: no echo, NaN: no valid range",
    "statistics": "once a second: counters and times of cycle, devices and process",
}
"""Topics of which a slow client receives the latest message only."""
ONCE: Final = {
    "state": "at the start and at each change: state and reason, with meaning and remedy",
    "loop": "each loop closure: counter, both keyframes, residual, reason",
    "faults": "at the start and at each change: all present faults, with meaning, remedy and cause",
}
"""Topics of which a client receives every message, up to :data:`KEPT`."""
RAW: Final = {"raw": "data between daemon and devices: bytes of the lidar's port, words of the photodiode"}
"""Topics of which a client receives every message, up to :data:`RAW_KEPT`."""
MAP: Final = {"map": "the map as tiles: first all, then those that have changed"}
"""Topic of which a client receives every tile, with the content at the time of sending."""
TOPICS: Final[Mapping[str, str]] = {**LATEST, **ONCE, **RAW, **MAP}

CLIENTS: Final = 32
"""Clients at once. One process has at most half of the places, one user its share (`hal.net.peers`)."""
KEPT: Final = 64
RAW_KEPT: Final = 256
BUFFER_BYTES: Final = 256 << 10
"""Bytes that may wait in this process for one client, and one message."""
LONGEST_REQUEST: Final = 4096
REQUESTS_PER_TURN: Final = 4
"""Largest number of requests of one client in one loop iteration; each may cause the whole map to be sent again."""
STUCK_S: Final = 60.0
"""Time in s after which a client that reads nothing is disconnected."""

_CREDENTIALS: Final = struct.Struct("@3i")

encode: Final = msgspec.msgpack.Encoder().encode
_request: Final = msgspec.msgpack.Decoder(dict[str, Any]).decode


def framed(message: Mapping[str, object]) -> bytes:
    """Encode a message with its length."""
    body = encode(message)
    return len(body).to_bytes(4, "little") + body


def credentials(transport: asyncio.Transport) -> tuple[int, int]:
    """IDs of the process and of the user at the other end (unix(7), SO_PEERCRED); 0, 0 where they are not known."""
    sock = transport.get_extra_info("socket")
    if sock is None:
        return 0, 0
    process, user, _ = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return process, user


class Server(Protocol):
    """Server interface that a session uses."""

    clients: set[Client]
    share: Share

    def hello(self) -> dict[str, object]:
        """First message to a client."""
        ...

    def welcome(self, client: Client, fresh: frozenset[str]) -> None:
        """Send the present values of newly subscribed topics."""
        ...

    def show(self, client: Client) -> None:
        """Send the tiles of the map that the client does not have."""
        ...


class Client(asyncio.Protocol):
    """Session of one tap.

    Attributes:
        wants: subscribed topics. replaced: messages that a newer one replaced before they were sent.
        process, user: IDs of the client; 0: not known.
        shown: the last tile of the map that was sent.
    """

    def __init__(self, server: Server) -> None:
        self.wants: frozenset[str] = frozenset()
        self.replaced = 0
        self.process = self.user = 0
        self._server = server
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()
        self._again: asyncio.TimerHandle | None = None
        self._latest: dict[str, bytes] = {}
        self._events: deque[tuple[str, bytes]] = deque(maxlen=KEPT)
        self._raw: deque[tuple[str, bytes]] = deque(maxlen=RAW_KEPT)
        self.shown = NOTHING_SHOWN
        self._stuck: asyncio.TimerHandle | None = None

    @property
    def stuck(self) -> bool:
        """Whether the client does not read its messages at present."""
        return self._stuck is not None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Send the greeting, or refuse the client if there are too many."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=BUFFER_BYTES)
        self.process, self.user = credentials(transport)
        if reason := self._no_place():
            self._refuse(reason)
            return
        self._server.clients.add(self)
        transport.write(framed(self._server.hello()))

    def _no_place(self) -> str:
        """Why there is no place for this client; empty where there is one."""
        clients = self._server.clients
        if len(clients) >= CLIENTS:
            return f"all {CLIENTS} connections are in use; close one"
        if self.process and sum(one.process == self.process for one in clients) >= max(1, CLIENTS // 2):
            return f"this program uses {CLIENTS // 2} of {CLIENTS} connections; close one"
        if self.process and sum(one.user == self.user for one in clients) >= most_of(CLIENTS):
            return f"this user's programs use {most_of(CLIENTS)} of {CLIENTS} connections; close one"
        return ""

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the client and stop its timers."""
        self._server.clients.discard(self)
        for timer in (self._stuck, self._again):
            if timer is not None:
                timer.cancel()

    def data_received(self, data: bytes) -> None:
        """Receive requests."""
        self._received += data
        if self._again is None:
            self._serve()

    def _serve(self) -> None:
        """Serve a few requests; the others wait for a later iteration, and nothing more is read until then."""
        self._again, share, more = None, self._server.share, True
        if share.begin():
            try:
                more = self._serve_some()
            finally:
                share.end()
        if self._transport is None:
            return
        if more:
            self._transport.pause_reading()
            self._again = share.later(self._serve)
        else:
            self._transport.resume_reading()

    def _serve_some(self) -> bool:
        """Serve some requests; return whether there are more."""
        for _ in range(REQUESTS_PER_TURN):
            if not self._whole():
                return False
            end = 4 + int.from_bytes(self._received[:4], "little")
            body = bytes(self._received[4:end])
            del self._received[:end]
            self._ask(body)
        return self._whole()

    def _whole(self) -> bool:
        """Whether a complete request has arrived."""
        if len(self._received) < 4:
            return False
        length = int.from_bytes(self._received[:4], "little")
        if length > LONGEST_REQUEST:
            self._refuse(f"the request has {length} bytes; the limit is {LONGEST_REQUEST}")
            return False
        return len(self._received) >= 4 + length

    def pause_writing(self) -> None:
        """The client does not read its messages: start to queue them."""
        self._stuck = asyncio.get_running_loop().call_later(STUCK_S, self._let_go)

    def resume_writing(self) -> None:
        """The client has caught up: send the queued events, and the latest message of each other topic."""
        if self._stuck is not None:
            self._stuck.cancel()
            self._stuck = None
        waiting = [*self._events, *self._latest.items(), *self._raw]
        self._events.clear()
        self._raw.clear()
        self._latest = {}
        for topic, body in waiting:
            self.tell(topic, body)
        if "map" in self.wants:
            self._server.show(self)

    def tell(self, topic: str, body: bytes) -> None:
        """Send a message, or queue it until the client has caught up; nothing where it has gone."""
        if self._transport is None or self._transport.is_closing():
            return
        if self._stuck is None:
            head = encode({"topic": topic, "replaced": self.replaced})
            # a map of three entries with the encoded data inserted: encoded once for all clients
            joined = b"\x83" + head[1:] + b"\xa4data" + body
            self._transport.write(len(joined).to_bytes(4, "little") + joined)
        elif topic in ONCE or topic in RAW:
            kept = self._events if topic in ONCE else self._raw
            self.replaced += len(kept) == kept.maxlen
            kept.append((topic, body))
        else:
            self.replaced += topic in self._latest
            self._latest[topic] = body

    def drop(self) -> None:
        """Close without sending what is pending."""
        if self._transport is not None:
            self._transport.abort()

    def _ask(self, body: bytes) -> None:
        try:
            wanted = _request(body).get("want")
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:  # a key that is no text; too deep
            self._refuse(f"the request is not a msgpack map: {error}")
            return
        if not isinstance(wanted, list) or not all(isinstance(topic, str) for topic in wanted):
            self._refuse("the request has no `want`, a list of topics")
        elif unknown := sorted(set(wanted) - set(TOPICS)):
            self._refuse(f"no such topic: {', '.join(unknown)[:100]}; available: {', '.join(TOPICS)}")
        else:
            before, self.wants = self.wants, frozenset(wanted)
            self._server.welcome(self, self.wants - before)

    def _refuse(self, text: str) -> None:
        self.wants = frozenset()
        self._received.clear()
        if self._transport is not None:
            self._transport.write(framed({"topic": "error", "text": text}))
            self._transport.close()

    def _let_go(self) -> None:
        log.info("a client of the stream has read nothing for %.0f s; the daemon disconnects it", STUCK_S)
        self.drop()
