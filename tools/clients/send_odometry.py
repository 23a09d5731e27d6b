"""Send wheel odometry and gyro readings to the daemon as UDP datagrams, standard library only.

    python send_odometry.py [HOST [PORT]]        (a demonstration: a robot that drives a circle)

Written from docs/udp.md alone: it shares no code with the daemon. Import `Sender` into a motor controller's program.
"""

from __future__ import annotations

import math
import random
import socket
import struct
import sys
import time
import zlib

SHARED_CLOCK = 1


class Sender:
    """Numbers, stamps and sends readings.

    Args:
        shared_clock: whether this program runs on the daemon's own computer, so that CLOCK_MONOTONIC is the same clock.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 15021, shared_clock: bool = False) -> None:
        family, _, _, _, self._address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._sock = socket.socket(family, socket.SOCK_DGRAM)
        self._session = random.getrandbits(32)
        self._flags = SHARED_CLOCK if shared_clock else 0
        self._seq = {b"LUOD": 0, b"LUIM": 0}

    def odometry(self, x: float, y: float, yaw: float, t: float | None = None) -> None:
        """Cumulative pose in metres and radians, true at `t` (time.monotonic(); None: now)."""
        self._send(b"LUOD", t, x, y, yaw)

    def imu(self, yaw_rate: float, t: float | None = None) -> None:
        """Yaw rate in rad/s, counter-clockwise."""
        self._send(b"LUIM", t, yaw_rate)

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def _send(self, magic: bytes, t: float | None, *values: float) -> None:
        seq, self._seq[magic] = self._seq[magic], (self._seq[magic] + 1) & 0xFFFFFFFF
        length = 36 + 8 * len(values)
        data = struct.pack("<4sHHIIII", magic, 1, length, self._session, seq, self._flags, 0)
        data += struct.pack(f"<{1 + len(values)}d", time.monotonic() if t is None else t, *values)
        self._sock.sendto(data + struct.pack("<I", zlib.crc32(data)), self._address)


if __name__ == "__main__":
    words = sys.argv[1:]
    try:
        sender = Sender(words[0] if words else "127.0.0.1", int(words[1]) if len(words) > 1 else 15021)
    except (OSError, ValueError) as error:
        sys.exit(f"{error}\n\n{__doc__}")
    begin = time.monotonic()
    while True:
        turned = 0.2 * (time.monotonic() - begin)
        sender.odometry(2.0 * math.sin(turned), 2.0 - 2.0 * math.cos(turned), turned)
        sender.imu(0.2)
        time.sleep(0.02)
