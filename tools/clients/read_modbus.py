"""Read the pose over Modbus UDP or TCP with nothing but the standard library.

    python read_modbus.py [HOST [PORT [tcp]]]

The lamps in view stand in a block of their own, see read_lights.py; the bound on the error in another, at 340.
Written from docs/modbus.md alone: it shares no code with the daemon, so it can be copied into any program.
"""

from __future__ import annotations

import socket
import struct
import sys
import time

STATES = ("STARTING", "NO_LIDAR", "MAPPING", "TRACKING", "DEGRADED", "AMBIGUOUS", "LOST", "RELOCATING")
REGISTERS, UINT16, INT32 = 64, 0xFFFF, -(2**31)  # the last two: what "not known" reads as


class Reader:
    """Reads the block of 64 input registers; one request, one answer."""

    def __init__(self, host: str = "127.0.0.1", port: int = 1502, tcp: bool = False) -> None:
        self._tcp = tcp
        kind = socket.SOCK_STREAM if tcp else socket.SOCK_DGRAM
        family, _, _, _, address = socket.getaddrinfo(host, port, type=kind)[0]
        self._sock = socket.socket(family, kind)
        self._sock.settimeout(0.5)
        self._sock.connect(address)
        self._transaction = 0

    def read(self) -> dict[str, float | int | str | None]:
        """The latest snapshot. Raises OSError (TimeoutError: ask again) or ValueError (not a lumiloop)."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        self._sock.sendall(struct.pack(">HHHBBHH", self._transaction, 0, 6, 1, 4, 0, REGISTERS))
        while True:
            answer = self._receive()
            if struct.unpack_from(">H", answer)[0] == self._transaction:
                return decode(answer)

    def _receive(self) -> bytes:
        if not self._tcp:
            return self._sock.recv(512)
        head = self._exactly(6)
        return head + self._exactly(struct.unpack_from(">H", head, 4)[0])

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self._sock.recv(size - len(data))
            if not part:
                raise ConnectionError("the server has closed the connection")
            data += part
        return data

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


def scaled(raw: int, per_unit: int, not_known: int = UINT16) -> float | None:
    """Value in SI units."""
    return None if raw == not_known else raw / per_unit


def decode(answer: bytes) -> dict[str, float | int | str | None]:
    """Values of an answer's 64 registers in SI units; None: not known."""
    if answer[7] & 0x80:
        raise ValueError(f"Modbus exception {answer[8]}")
    block = answer[9:]
    magic, version, seq, state, reason, fault, flags = struct.unpack_from(">HHIHHHH", block)
    if (magic, version) != (0x4C4C, 1) or seq != struct.unpack_from(">I", block, 124)[0]:
        raise ValueError("not a lumiloop register block of version 1, or torn")
    age, t_mono = struct.unpack_from(">HQ", block, 18)
    x, y, yaw = struct.unpack_from(">iii", block, 36)
    sigma_x, sigma_y, sigma_yaw = struct.unpack_from(">HHH", block, 72)
    (jumps,), (loops,) = struct.unpack_from(">H", block, 90), struct.unpack_from(">H", block, 104)
    return {
        "seq": seq, "state": STATES[state] if state < len(STATES) else str(state), "reason": reason, "fault": fault,
        "x_known": flags >> 2 & 1, "y_known": flags >> 3 & 1, "yaw_known": flags >> 4 & 1, "age": scaled(age, 10_000),
        "bounded": flags >> 6 & 1, "alert": flags >> 7 & 1,
        "x": scaled(x, 10_000, INT32), "y": scaled(y, 10_000, INT32), "yaw": scaled(yaw, 1_000_000, INT32),
        "sigma_x": scaled(sigma_x, 10_000), "sigma_y": scaled(sigma_y, 10_000), "sigma_yaw": scaled(sigma_yaw, 10_000),
        "jumps": jumps, "loops": loops, "t_mono": scaled(t_mono, 1_000_000, 2**64 - 1),
    }  # fmt: skip


if __name__ == "__main__":
    words = sys.argv[1:]
    try:
        reader = Reader(words[0] if words else "127.0.0.1", int(words[1]) if len(words) > 1 else 1502, "tcp" in words)
        while True:
            try:
                print(reader.read())
            except TimeoutError:
                print("no answer")
            time.sleep(0.1)
    except (OSError, ValueError) as error:
        sys.exit(f"{error}: is lumiloop running, and do `bind` and `allow` admit this machine?\n\n{__doc__}")
