"""UDP subscription protocol for pose datagrams: leases that clients request and renew with a cookie.

The protocol cannot direct datagrams to a third party. An address first receives a *cookie*, in a reply no larger than
its request, and pose datagrams only after it has returned the cookie. The cookie is a keyed hash of address and time,
so the daemon stores nothing for addresses that never reply. Subscribers are few, leases are short.

    "LUSB", version u16, length u16, status u16, lease u16, cookie u64, CRC-32    24 bytes, little-endian, both ways
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import secrets
import socket
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, Final

from daemon.system.logging import Sparing
from hal.net import inet
from hal.net.fair_share import Reader, Share
from hal.net.peers import full_for
from hal.net.reply_address import PACKET_INFO_SPACE, ReplySource, enable_packet_info, reply_source, send_from

MAGIC: Final = b"LUSB"
VERSION: Final = 1
SUBSCRIBERS: Final = 16
LONGEST_LEASE_S: Final = 60
COOKIE_S: Final = 120.0
"""Period of the cookie's time input, s: a cookie is valid for one to two periods."""
LAYOUT: Final = (
    ("magic", "4s"), ("version", "H"), ("length", "H"), ("status", "H"), ("lease", "H"), ("cookie", "Q"),
)  # fmt: skip
"""Fields before the CRC-32, little-endian, of a request and of its reply (codes of the `struct` module)."""
_BODY: Final = struct.Struct("<" + "".join(code for _, code in LAYOUT))
_CRC: Final = struct.Struct("<I")
SIZE: Final = _BODY.size + _CRC.size
_PER_TURN: Final = 8

log = logging.getLogger(__name__)


class Status(IntEnum):
    """Status field of a subscription datagram. Numbers are part of the contract: never renumber."""

    ASK = 0  # client: requests pose datagrams for `lease` seconds; 0: ends them
    COOKIE = 1  # daemon: repeat the request with this cookie
    GRANTED = 2  # daemon: for `lease` seconds from now
    FULL = 3  # daemon: the largest number of subscribers is reached
    ENDED = 4  # daemon: no more are sent


@dataclass(frozen=True, slots=True)
class Message:
    """A subscription datagram; ``lease`` in seconds."""

    status: Status
    lease: int
    cookie: int


def encode(message: Message) -> bytes:
    """Encode a subscription datagram."""
    body = _BODY.pack(MAGIC, VERSION, SIZE, message.status, message.lease, message.cookie)
    return body + _CRC.pack(zlib.crc32(body))


def decode(data: bytes) -> Message:
    """Decode a subscription datagram.

    Raises:
        ValueError: not a subscription datagram of this version, or damaged.
    """
    if len(data) != SIZE or zlib.crc32(data[: _BODY.size]) != _CRC.unpack_from(data, _BODY.size)[0]:
        raise ValueError("not a subscription datagram, or damaged")
    magic, version, length, status, lease, cookie = _BODY.unpack_from(data)
    if magic != MAGIC or version != VERSION or length != SIZE:
        raise ValueError("not a subscription datagram of this version")
    return Message(Status(status), lease, cookie)


def peer_host(peer: Any) -> str:
    """Address of the host of a peer: see :class:`Leases`."""
    (host, *_), _ = peer
    return str(host)


class Leases:
    """Subscribers with the end of their leases. Pure: the time is an argument, and nothing is sent.

    A peer is a hashable key: the client's socket address, and our address to which it sent. One host has only a share
    of the places (`hal.net.peers`).

    Attributes:
        refused: requests rejected because the largest number of subscribers was reached.
    """

    def __init__(self, key: bytes | None = None) -> None:
        self.refused = 0
        self._key = key or secrets.token_bytes(32)
        self._until: dict[Any, float] = {}

    def __len__(self) -> int:
        return len(self._until)

    def answer(self, peer: Any, message: Message, now: float) -> Message | None:
        """Reply to a client's datagram; None for a datagram that is no request."""
        if message.status is not Status.ASK:
            return None
        if message.cookie not in (self._cookie(peer, now), self._cookie(peer, now - COOKIE_S)):
            return Message(Status.COOKIE, 0, self._cookie(peer, now))
        if message.lease == 0:
            self._until.pop(peer, None)
            return Message(Status.ENDED, 0, message.cookie)
        self._expire(now)
        if peer not in self._until and (len(self._until) >= SUBSCRIBERS or self._greedy(peer)):
            self.refused += 1
            return Message(Status.FULL, 0, message.cookie)
        lease = min(message.lease, LONGEST_LEASE_S)
        self._until[peer] = now + lease
        return Message(Status.GRANTED, lease, self._cookie(peer, now))

    def _greedy(self, peer: Any) -> bool:
        """Whether the peer's host has its share of the places."""
        return full_for(peer_host(peer), map(peer_host, self._until), SUBSCRIBERS)

    def peers(self, now: float) -> list[Any]:
        """Peers with a valid lease."""
        self._expire(now)
        return list(self._until)

    def _expire(self, now: float) -> None:
        for peer in [peer for peer, until in self._until.items() if until <= now]:
            del self._until[peer]

    def _cookie(self, peer: Any, now: float) -> int:
        text = f"{peer}|{now // COOKIE_S:.0f}".encode()
        return int.from_bytes(hashlib.blake2s(text, digest_size=8, key=self._key).digest(), "little")


class Subscriptions:
    """Socket that receives subscription requests, and sends datagrams to the subscribers from the same port.

    Args:
        bind: address of this computer. port: 0: any free one, available as :attr:`port` once open.
        allowed: whether a host may subscribe.

    Attributes:
        sent, dropped: datagrams; dropped ones were not accepted by the kernel. malformed: datagrams that were no
            request.
    """

    def __init__(self, bind: str, port: int, allowed: Callable[[str], bool]) -> None:
        self.leases = Leases()
        self.sent = self.dropped = self.malformed = 0
        self._bind = bind
        self._wanted = port
        self._allowed = allowed
        self._sock: socket.socket | None = None
        self._space = 0  # size of the kernel's ancillary data of a datagram
        self._reader: Reader | None = None
        self._lines = Sparing(log, lines=1)  # a client that subscribes and ends repeatedly must not fill the log

    @property
    def port(self) -> int:
        """Port number while open."""
        return self._wanted if self._sock is None else int(self._sock.getsockname()[1])

    async def start(self) -> None:
        """Open the socket and serve requests.

        Raises:
            DeviceRefused: port in use, or not permitted. DeviceMissing: no such address here.
        """
        (address, *_) = await inet.resolve(self._bind, self._wanted, passive=True)
        try:
            self._sock = inet.listening(address, socket.SOCK_DGRAM)
        except OSError as error:
            device = f"pose subscriptions on {self._bind}:{self._wanted}"
            raise inet.refusal(device, "pose.receivers", self._wanted, error) from error
        self._space = PACKET_INFO_SPACE if enable_packet_info(self._sock) else 0
        self._reader = Reader(self._sock.fileno(), partial(self._serve, self._sock), Share())

    async def close(self) -> None:
        """Close the socket; idempotent. Leases stay valid."""
        sock, self._sock = self._sock, None
        if self._reader is not None:
            self._reader.close()
        if sock is not None:
            sock.close()

    def send(self, data: bytes) -> None:
        """Send to every subscriber; never waits."""
        if self._sock is None or not len(self.leases):
            return
        for peer, source in self.leases.peers(asyncio.get_running_loop().time()):
            self._send(self._sock, data, peer, source)

    def _send(self, sock: socket.socket, data: bytes, peer: Any, source: ReplySource) -> None:
        try:
            send_from(sock, data, source, peer)
        except OSError:
            self.dropped += 1
        else:
            self.sent += 1

    def _serve(self, sock: socket.socket) -> None:
        now = asyncio.get_running_loop().time()
        for _ in range(_PER_TURN):
            try:
                data, told, _, peer = sock.recvmsg(SIZE + 1, self._space)
            except OSError:  # no more data, or a network error caused by an earlier datagram
                return
            if not self._allowed(peer[0]):
                continue
            try:
                message = decode(data)
            except ValueError:
                self.malformed += 1
                continue
            before, source = len(self.leases), reply_source(told)
            if (answer := self.leases.answer((peer, source), message, now)) is not None:
                self._send(sock, encode(answer), peer, source)
            if (count := len(self.leases)) != before:
                last = f"latest request from {peer[0]}:{peer[1]}"
                self._lines.say(now, logging.INFO, f"pose datagrams: {count} subscribers, {last}")
