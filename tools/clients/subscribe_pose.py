"""Subscribe to pose datagrams and print them, with nothing but the standard library.

    python subscribe_pose.py [HOST [PORT]]        for `pose.receivers = ["*:5601"]`

Written from docs/udp.md alone: it shares no code with the daemon, so it can be copied into any program.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
import zlib
from collections.abc import Iterator

ASK, COOKIE, GRANTED, FULL, ENDED = range(5)
LEASE_S = 30
STATES = ("STARTING", "NO_LIDAR", "MAPPING", "TRACKING", "DEGRADED", "AMBIGUOUS", "LOST", "RELOCATING")


class Subscription:
    """Keeps a lease alive while poses are taken from it."""

    def __init__(self, host: str = "127.0.0.1", port: int = 5601) -> None:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._sock = socket.socket(family, kind)
        self._sock.connect(address)
        self._sock.settimeout(1.0)
        self._cookie = 0
        self._ask_at = 0.0
        self.full = False

    def poses(self) -> Iterator[dict[str, float | int | str | None]]:
        """Poses as they come; without end. Raises ConnectionRefusedError where nobody listens."""
        while True:
            try:
                if time.monotonic() >= self._ask_at:
                    self._ask(LEASE_S)
                data = self._sock.recv(1024)
            except ConnectionRefusedError:
                print("nobody listens there: is lumiloop running, with `*:PORT` in `pose.receivers`?", file=sys.stderr)
                time.sleep(1.0)
                self._ask_at = 0.0
                continue
            except TimeoutError:
                self._ask_at = 0.0  # the daemon was restarted, or an answer was lost
                continue
            if data[:4] == b"LUSB":
                self._answered(data)
            elif (pose := decode(data)) is not None:
                yield pose

    def close(self) -> None:
        """End the lease."""
        self._ask(0)
        self._sock.close()

    def _ask(self, lease: int) -> None:
        body = struct.pack("<4sHHHHQ", b"LUSB", 1, 24, ASK, lease, self._cookie)
        self._sock.send(body + struct.pack("<I", zlib.crc32(body)))
        self._ask_at = time.monotonic() + 1.0

    def _answered(self, data: bytes) -> None:
        if len(data) != 24 or zlib.crc32(data[:20]) != struct.unpack_from("<I", data, 20)[0]:
            return
        _, _, status, lease, self._cookie = struct.unpack_from("<HHHHQ", data, 4)
        self.full = status == FULL
        if status == COOKIE:
            self._ask(LEASE_S)
        elif status == GRANTED:
            self._ask_at = time.monotonic() + lease / 3.0


def decode(data: bytes) -> dict[str, float | int | str | None] | None:
    """The first values of a pose datagram in SI units; None: it is none, or damaged."""
    if len(data) < 132 or data[:4] != b"LUMI" or struct.unpack_from("<HH", data, 4) != (1, len(data)):
        return None
    if zlib.crc32(data[:-4]) != struct.unpack_from("<I", data, len(data) - 4)[0]:
        return None
    seq, state, reason, fault, flags = struct.unpack_from("<IHHHH", data, 8)
    x, y, yaw = struct.unpack_from("<iii", data, 40)
    known = flags & 1 == 1
    return {
        "seq": seq, "state": STATES[state] if state < len(STATES) else str(state), "reason": reason, "fault": fault,
        "x": x / 1e4 if known else None, "y": y / 1e4 if known else None, "yaw": yaw / 1e6 if known else None,
    }  # fmt: skip


if __name__ == "__main__":
    words = sys.argv[1:]
    try:
        for pose in Subscription(words[0] if words else "127.0.0.1", int(words[1]) if len(words) > 1 else 5601).poses():
            print(pose, flush=True)
    except KeyboardInterrupt:
        sys.exit(130)
    except (OSError, ValueError) as error:
        sys.exit(f"{error}\n\n{__doc__}")
