"""Which of this computer's addresses a datagram was sent to: its answer has to come from there.

A client with a connected socket takes answers from no other address, and the kernel would choose one by the way back.
A socket that is bound to one address has no choice; only those that are bound to all of them need this.
(ip(7), IP_PKTINFO; RFC 3542, 6.1 and 6.2.)
"""

from __future__ import annotations

import socket
import struct
from typing import Any, Final

_IP_PKTINFO: Final = 8  # linux/in.h; the socket module has no name for it
_IPV4: Final = struct.Struct("@i4s4s")  # interface, our address on it, address in the datagram's header
_IPV6: Final = struct.Struct("@16sI")  # address in the datagram's header, interface
ASKED_SPACE: Final = socket.CMSG_SPACE(_IPV6.size)
"""Ancillary bytes to ask `recvmsg` for."""
_EVERY: Final = ("0.0.0.0", "::")
_GROUP: Final = 0xFF
_LINK_LOCAL: Final = 0xFE80

Source = tuple[tuple[int, int, bytes], ...]
"""Ancillary data for `sendmsg`; empty: the kernel chooses."""


def tell_asked(sock: socket.socket) -> bool:
    """Have the kernel tell it with each datagram where a bound socket has all addresses; whether it does."""
    if sock.getsockname()[0] not in _EVERY:
        return False
    try:
        if sock.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
        else:
            sock.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
    except OSError:  # a kernel without it answers as it sees fit
        return False
    return True


def asked_at(ancillary: list[tuple[int, int, Any]]) -> Source:
    """What to give to `sendmsg` so that an answer comes from where its request was sent to."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.IPPROTO_IP, _IP_PKTINFO) and len(data) == _IPV4.size:
            _, ours, _ = _IPV4.unpack(data)
            return ((level, kind, _IPV4.pack(0, ours, bytes(4))),)
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO) and len(data) == _IPV6.size:
            ours, interface = _IPV6.unpack(data)
            if ours[0] == _GROUP:
                return ()  # nothing can be sent from there
            linked = int.from_bytes(ours[:2], "big") & 0xFFC0 == _LINK_LOCAL
            return ((level, kind, _IPV6.pack(ours, interface if linked else 0)),)
    return ()


def send_from(sock: socket.socket, data: bytes, source: Source, peer: Any) -> None:
    """Send a datagram from there; raises OSError."""
    if source:
        sock.sendmsg([data], source, 0, peer)
    else:
        sock.sendto(data, peer)
