"""UDP pose datagrams to configured receivers (unicast and multicast) and to subscribers.

No call waits: a datagram that the kernel does not accept at once is dropped. A datagram to a group is sent once for all
listeners, and does not leave the local network (time to live 1, RFC 1112).
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from daemon.config.endpoints import parse_endpoint
from daemon.publish.modbus import registers
from daemon.publish.udp_subscriptions import Subscriptions
from daemon.snapshot import Snapshot
from hal.errors import DeviceMissing
from hal.net import inet

RETRY_S: Final = 5.0  # of a failed name lookup: the network often starts after the robot's programs
REFRESH_S: Final = 300.0  # a name's address may move to another computer

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Receiver:
    """One configured receiver and the result of its datagrams.

    Attributes:
        name: as configured. sent, dropped: datagrams; a dropped one was not accepted by the kernel, or the receiver's
            name was not resolved. address: None while the name is not resolved.
    """

    name: str
    host: str
    port: int
    address: inet.Address | None = None
    sent: int = 0
    dropped: int = 0
    reachable: bool = True


class PoseSender:
    """Sends each snapshot as one datagram to every receiver.

    Args:
        receivers: as `daemon.config.endpoints.parse_endpoint` accepts them.
        interface: address of this computer from which multicast is sent; empty: the system's route.
        subscriptions: present subscribers; None: no subscriptions.

    Raises:
        ValueError: a receiver that is not of that form.
    """

    def __init__(
        self, receivers: Sequence[str], interface: str = "", subscriptions: Subscriptions | None = None
    ) -> None:
        self.receivers = [Receiver(text, *parse_endpoint(text)) for text in receivers]
        self._interface = interface
        self._subscriptions = subscriptions
        self._sockets: dict[tuple[socket.AddressFamily, int], socket.socket] = {}  # by network interface
        self._lookups: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Resolve the receivers' addresses: numeric ones at once, names beside the loop and again every few minutes."""
        for receiver in self.receivers:
            if found := inet.numeric(receiver.host, receiver.port):
                receiver.address = found[0]
            else:
                self._lookups.append(asyncio.create_task(self._look_up(receiver)))

    @property
    def failing(self) -> bool:
        """Whether a configured receiver is unreachable: the network is down, or its name is not resolved."""
        return not all(receiver.reachable for receiver in self.receivers)

    def publish(self, snapshot: Snapshot) -> None:
        """Send to all; never waits, and raises nothing for network errors."""
        subscribed = self._subscriptions is not None and len(self._subscriptions.leases) > 0
        if not self.receivers and not subscribed:
            return
        data = registers.encode_datagram(snapshot)
        for receiver in self.receivers:
            self._send(receiver, data)
        if self._subscriptions is not None:
            self._subscriptions.send(data)

    async def close(self) -> None:
        """Stop sending; idempotent."""
        lookups, self._lookups = self._lookups, []
        for task in lookups:
            task.cancel()
        await asyncio.gather(*lookups, return_exceptions=True)
        for sock in self._sockets.values():
            sock.close()
        self._sockets.clear()

    def _send(self, receiver: Receiver, data: bytes) -> None:
        if receiver.address is None:
            receiver.dropped += 1
            return
        kind = receiver.address[0], inet.scope(receiver.address)
        sock = self._sockets.get(kind)
        try:
            if sock is None:
                sock = self._sockets[kind] = self._open(*kind)
            sock.sendto(data, receiver.address[1])
        except BlockingIOError:
            receiver.dropped += 1
        except OSError as error:
            receiver.dropped += 1
            self._lost(receiver, error.strerror or str(error))
        else:
            receiver.sent += 1
            if not receiver.reachable:
                receiver.reachable = True
                log.info("pose receiver %s can be reached again", receiver.name)

    def _open(self, family: socket.AddressFamily, interface: int) -> socket.socket:
        """Open a socket for sending; multicast uses the given interface."""
        sock = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            if family == socket.AF_INET and self._interface:
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self._interface))
            elif family == socket.AF_INET6 and interface:
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, interface)
        except OSError:
            sock.close()
            raise
        return sock

    def _lost(self, receiver: Receiver, problem: str) -> None:
        """Log the loss of a receiver once; the heartbeat gives the warning, with the fault's number."""
        if receiver.reachable:
            receiver.reachable = False
            log.info("pose receiver %s: %s; datagrams to it are dropped until it is back", receiver.name, problem)

    async def _look_up(self, receiver: Receiver) -> None:
        while True:
            try:
                receiver.address = (await inet.resolve(receiver.host, receiver.port))[0]
                pause = REFRESH_S
            except DeviceMissing as error:
                if receiver.address is None:
                    self._lost(receiver, error.problem)
                pause = RETRY_S
            except Exception:  # such as no thread left: the receiver is tried again later
                log.exception("pose receiver %s cannot be looked up; it is tried again", receiver.name)
                pause = RETRY_S
            await asyncio.sleep(pause)
