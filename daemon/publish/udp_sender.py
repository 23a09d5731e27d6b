"""UDP pose datagrams to configured receivers (unicast and multicast) and to subscribers.

No call waits: a datagram that the kernel does not accept at once is dropped. A datagram to a group is sent once for all
listeners, and does not leave the local network (time to live 1, RFC 1112).
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from daemon.config.endpoints import parse_endpoint
from daemon.publish.modbus import registers
from daemon.publish.udp_subscriptions import Subscriptions
from daemon.snapshot import Snapshot
from hal.errors import DeviceMissing
from hal.net import inet
from hal.net.interfaces import interface_of

RETRY_S: Final = 5.0  # of a failed name lookup: the network often starts after the robot's programs
REFRESH_S: Final = 300.0  # a name's address may move to another computer

_MREQN: Final = struct.Struct("@4s4si")  # ip_mreqn (ip(7)): group, own address, interface

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
        interface: address of this computer by whose interface multicast leaves; empty: the system's route.
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
        self._sockets: dict[tuple[socket.AddressFamily, str | int], socket.socket] = {}
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
        kind = receiver.address[0], self._way(receiver.address)
        sock = self._sockets.get(kind)
        try:
            if sock is None:
                sock = self._sockets[kind] = self._open(*kind)
            sock.sendto(data, receiver.address[1])
        except BlockingIOError:
            receiver.dropped += 1
        except OSError as error:
            receiver.dropped += 1
            if kind[1] and (failed := self._sockets.pop(kind, None)) is not None:
                failed.close()  # its interface may have come back with another number
            self._lost(receiver, error.strerror or str(error))
        else:
            receiver.sent += 1
            if not receiver.reachable:
                receiver.reachable = True
                log.info("pose receiver %s can be reached again", receiver.name)

    def _way(self, address: inet.Address) -> str | int:
        """By what a datagram leaves: the number of its network interface, or an own address; empty: the route."""
        return inet.scope(address) or (self._interface if inet.is_group(address) else "")

    def _open(self, family: socket.AddressFamily, way: str | int) -> socket.socket:
        """Open a socket for sending; multicast leaves by ``way``, see :meth:`_way`. Raises OSError."""
        sock = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            index = way if isinstance(way, int) else interface_of(way) if way else 0
            if index and family == socket.AF_INET6:
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
            elif index:
                own = way if isinstance(way, str) and ":" not in way else "0.0.0.0"
                request = _MREQN.pack(bytes(4), socket.inet_aton(own), index)
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, request)
        except OSError:
            sock.close()
            raise
        return sock

    def _lost(self, receiver: Receiver, problem: str) -> None:
        """Log the loss of a receiver once; the heartbeat gives the warning, with the fault's number."""
        if receiver.reachable:
            receiver.reachable = False
            log.info(
                "pose receiver %s: %s; datagrams to it are dropped until it can be reached", receiver.name, problem
            )

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
                log.exception("the name of pose receiver %s cannot be resolved; the daemon tries again", receiver.name)
                pause = RETRY_S
            await asyncio.sleep(pause)
