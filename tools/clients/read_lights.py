"""Read the lamps in view, and the position from them alone, over Modbus UDP with nothing but the standard library.

    python read_lights.py [HOST [PORT]]

Written from docs/modbus.md alone: it shares no code with the daemon, so it can be copied into any program.
"""

from __future__ import annotations

import socket
import struct
import sys
import time

FIRST, REGISTERS, ROWS = 200, 120, 16
FIXES = ("NONE", "STARTING", "GOOD", "HELD", "AMBIGUOUS", "LOST")
USES = ("OTHER", "ACCEPTED", "OCCLUDED", "REJECTED", "RIM", "FAINT", "TWIN", "UNSURVEYED", "MISSING", "PAUSED")
UINT16, INT16, UINT32, INT32 = 0xFFFF, -(2**15), 2**32 - 1, -(2**31)  # what "not known" reads as


class Reader:
    """Reads the block of 120 input registers; one datagram, one answer."""

    def __init__(self, host: str = "127.0.0.1", port: int = 1502) -> None:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._sock = socket.socket(family, kind)
        self._sock.settimeout(0.5)
        self._sock.connect(address)
        self._transaction = 0

    def read(self) -> dict[str, object]:
        """The latest snapshot. Raises OSError (TimeoutError: ask again) or ValueError (not a lumiloop)."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        self._sock.send(struct.pack(">HHHBBHH", self._transaction, 0, 6, 1, 4, FIRST, REGISTERS))
        while True:
            answer = self._sock.recv(512)
            if struct.unpack_from(">H", answer)[0] == self._transaction:
                return decode(answer)

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


def scaled(raw: int, per_unit: float, not_known: int) -> float | None:
    """Value in SI units."""
    return None if raw == not_known else raw / per_unit


def named(number: int, names: tuple[str, ...]) -> str | None:
    """Name of a number, the number itself where a newer daemon has more of them."""
    return None if number == UINT16 else names[number] if number < len(names) else str(number)


def decode(answer: bytes) -> dict[str, object]:
    """Values of an answer's 120 registers in SI units, with a list of links, strongest first; None: not known."""
    if answer[7] & 0x80:
        raise ValueError(f"Modbus exception {answer[8]}")
    block = answer[9:]
    magic, version, seq, fix, used, x, y, yaw, *sigmas, age = struct.unpack_from(">HHIHHiiiHHHH", block)
    if (magic, version) != (0x4C49, 1) or seq != struct.unpack_from(">I", block, 236)[0]:
        raise ValueError("not a lumiloop block of lights of version 1, or torn")
    sigma_x, sigma_y, sigma_yaw = (scaled(sigma, 10_000, UINT16) for sigma in sigmas)
    rows = (struct.unpack_from(">HHHIh", block, 44 + 12 * row) for row in range(ROWS))
    return {
        "seq": seq, "fix": named(fix, FIXES), "used": None if used == UINT16 else used,
        "x": scaled(x, 10_000, INT32), "y": scaled(y, 10_000, INT32), "yaw": scaled(yaw, 1_000_000, INT32),
        "sigma_x": sigma_x, "sigma_y": sigma_y, "sigma_yaw": sigma_yaw, "age": scaled(age, 10_000, UINT16),
        "links": [link(*row) for row in rows if row[0] != UINT16],
    }  # fmt: skip


def link(code: int, lamp: int, use: int, strength: int, residual: int) -> dict[str, object]:
    """One lamp in view: photocurrent in A, and ln(received / expected)."""
    return {
        "code": code, "lamp": None if lamp == UINT16 else lamp, "use": named(use, USES),
        "strength": scaled(strength, 1e12, UINT32), "residual": scaled(residual, 10_000, INT16),
    }  # fmt: skip


if __name__ == "__main__":
    words = sys.argv[1:]
    try:
        reader = Reader(words[0] if words else "127.0.0.1", int(words[1]) if len(words) > 1 else 1502)
        while True:
            try:
                print(reader.read())
            except TimeoutError:
                print("no answer")
            time.sleep(0.1)
    except (OSError, ValueError) as error:
        sys.exit(f"{error}: is lumiloop running, and do `bind` and `allow` admit this machine?\n\n{__doc__}")
