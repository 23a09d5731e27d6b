"""Kernel receive timestamps of datagrams (SO_TIMESTAMPNS): arrival times do not depend on the loop's delay."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from typing import Any, Final

MAX_AGE_S: Final = 1.0
"""An older timestamp is ignored."""
_TIMESPEC: Final = struct.Struct("@ll")
_SO_TIMESTAMPNS: Final = 35  # asm-generic/socket.h; the socket module has no name for it
STAMP_SPACE: Final = socket.CMSG_SPACE(_TIMESPEC.size)
"""Size of the ancillary buffer for `recvmsg`, bytes."""


def enable_rx_timestamps(sock: socket.socket) -> None:
    """Enable kernel timestamps on a socket; does nothing where the kernel has none."""
    with contextlib.suppress(OSError):  # without it the time of reading is used
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def kernel_age(ancillary: list[tuple[int, int, Any]]) -> float:
    """Seconds since the kernel received a datagram; 0 without a timestamp, or where the clock was set in between."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            age = (time.clock_gettime_ns(time.CLOCK_REALTIME) - seconds * 1_000_000_000 - nanoseconds) * 1e-9
            return age if 0.0 <= age <= MAX_AGE_S else 0.0
    return 0.0
