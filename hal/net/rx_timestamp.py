"""When the kernel received a datagram: a loop that is late for it makes no reading late."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from typing import Any, Final

MAX_AGE_S: Final = 1.0
"""An older stamp is not believed."""
_TIMESPEC: Final = struct.Struct("@ll")
_SO_TIMESTAMPNS: Final = 35  # asm-generic/socket.h; the socket module has no name for it
STAMP_SPACE: Final = socket.CMSG_SPACE(_TIMESPEC.size)
"""Ancillary bytes to ask `recvmsg` for."""


def stamp_arrivals(sock: socket.socket) -> None:
    """Have the kernel stamp what a socket receives; without a word where it cannot."""
    with contextlib.suppress(OSError):  # a kernel without it: the time of reading is used
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def kernel_age(ancillary: list[tuple[int, int, Any]]) -> float:
    """Seconds since the kernel received a datagram; 0 where it does not say, or its clock was set in between."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            age = (time.clock_gettime_ns(time.CLOCK_REALTIME) - seconds * 1_000_000_000 - nanoseconds) * 1e-9
            return age if 0.0 <= age <= MAX_AGE_S else 0.0
    return 0.0
