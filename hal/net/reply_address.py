"""Source address of a UDP reply: the address that the request was sent to (ip(7), IP_PKTINFO; RFC 3542, 6.1, 6.2).

A client with a connected socket accepts replies from that address only, while the kernel would choose one by the route.
Only a socket bound to all addresses of this computer needs this.
"""

from __future__ import annotations

import socket
import struct
from typing import Any, Final

_IP_PKTINFO: Final = 8  # linux/in.h; the socket module has no name for it
_IPV4: Final = struct.Struct("@i4s4s")  # interface, our address on it, address in the datagram's header
_IPV6: Final = struct.Struct("@16sI")  # address in the datagram's header, interface
PACKET_INFO_SPACE: Final = socket.CMSG_SPACE(_IPV6.size)
"""Size of the ancillary buffer for `recvmsg`, bytes."""
_EVERY: Final = ("0.0.0.0", "::")
_GROUP: Final = 0xFF
_LINK_LOCAL: Final = 0xFE80

ReplySource = tuple[tuple[int, int, bytes], ...]
"""Ancillary data for `sendmsg`; empty: the kernel chooses."""


def enable_packet_info(sock: socket.socket) -> bool:
    """Enable IP_PKTINFO on a socket that is bound to all addresses; True where the kernel will deliver it."""
    if sock.getsockname()[0] not in _EVERY:
        return False
    try:
        if sock.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
        else:
            sock.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
    except OSError:  # a kernel without it chooses the source address itself
        return False
    return True


def reply_source(ancillary: list[tuple[int, int, Any]]) -> ReplySource:
    """Ancillary data for `sendmsg` that make the reply leave from the address its request was sent to."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.IPPROTO_IP, _IP_PKTINFO) and len(data) == _IPV4.size:
            _, ours, _ = _IPV4.unpack(data)
            return ((level, kind, _IPV4.pack(0, ours, bytes(4))),)
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO) and len(data) == _IPV6.size:
            ours, interface = _IPV6.unpack(data)
            if ours[0] == _GROUP:
                return ()  # a multicast group cannot be a source address
            linked = int.from_bytes(ours[:2], "big") & 0xFFC0 == _LINK_LOCAL
            return ((level, kind, _IPV6.pack(ours, interface if linked else 0)),)
    return ()


def send_from(sock: socket.socket, data: bytes, source: ReplySource, peer: Any) -> None:
    """Send a datagram from the source address; raises OSError."""
    if source:
        sock.sendmsg([data], source, 0, peer)
    else:
        sock.sendto(data, peer)
