"""Read the pose over a serial line (Modbus RTU) with nothing but the standard library, on Linux.

    python read_rtu.py /dev/ttyUSB0 [BAUD [UNIT]]        19200 bit/s, even parity, unit 1, as `modbus.serial` has it

Written from docs/modbus.md alone: it shares no code with the daemon, so it can be copied into any program.
"""

from __future__ import annotations

import os
import select
import struct
import sys
import termios
import time
import tty

STATES = ("STARTING", "NO_LIDAR", "MAPPING", "TRACKING", "DEGRADED", "AMBIGUOUS", "LOST", "RELOCATING")
RATES = {int(name[1:]): code for name, code in vars(termios).items() if name[0] == "B" and name[1:].isdigit()}
REGISTERS, INT32 = 64, -(2**31)  # to be read at once; what "not known" reads as


def crc16(data: bytes) -> bytes:
    """The frame's checksum, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


class Line:
    """The master's end of a serial line."""

    def __init__(self, path: str, baud: int = 19200, unit: int = 1) -> None:
        self._unit = unit
        self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._fd)
        settings = termios.tcgetattr(self._fd)
        settings[2] &= ~(termios.CSTOPB | termios.PARODD)
        settings[2] |= termios.CS8 | termios.PARENB | termios.CLOCAL | termios.CREAD
        settings[4] = settings[5] = RATES[baud]
        try:
            termios.tcsetattr(self._fd, termios.TCSANOW, settings)
        except termios.error as error:
            if not os.ttyname(self._fd).startswith("/dev/pts/"):  # a pseudo-terminal has no parity, and needs none
                os.close(self._fd)
                raise OSError(f"the port cannot do {baud} bit/s with even parity: {error.args[-1]}") from error

    def read(self, patience_s: float = 1.0) -> dict[str, float | int | str | None]:
        """The latest snapshot. Raises TimeoutError (ask again) or ValueError (damaged, or not a lumiloop)."""
        termios.tcflush(self._fd, termios.TCIFLUSH)
        request = struct.pack(">BBHH", self._unit, 4, 0, REGISTERS)
        os.write(self._fd, request + crc16(request))
        answer = self._exactly(5 + 2 * REGISTERS, time.monotonic() + patience_s)
        if answer[:3] != bytes((self._unit, 4, 2 * REGISTERS)) or crc16(answer[:-2]) != answer[-2:]:
            raise ValueError(f"a damaged answer, or an exception: {answer[:5].hex()}")
        return decode(answer[3:-2])

    def _exactly(self, size: int, end: float) -> bytes:
        data = b""
        while len(data) < size and not (len(data) >= 5 and data[1] & 0x80):  # an exception is short
            if not select.select([self._fd], [], [], max(0.0, end - time.monotonic()))[0]:
                raise TimeoutError("no answer")
            data += os.read(self._fd, size - len(data))
        return data

    def close(self) -> None:
        """Close the line."""
        os.close(self._fd)


def decode(block: bytes) -> dict[str, float | int | str | None]:
    """The first values of the 64 registers in SI units; None: not known."""
    magic, version, seq, state, reason, fault, flags = struct.unpack_from(">HHIHHHH", block)
    if (magic, version) != (0x4C4C, 1) or seq != struct.unpack_from(">I", block, 124)[0]:
        raise ValueError("not a lumiloop register block of version 1, or torn")
    x, y, yaw = struct.unpack_from(">iii", block, 36)
    return {
        "seq": seq, "state": STATES[state] if state < len(STATES) else str(state), "reason": reason, "fault": fault,
        "flags": flags, "x": None if x == INT32 else x / 1e4, "y": None if y == INT32 else y / 1e4,
        "yaw": None if yaw == INT32 else yaw / 1e6,
    }  # fmt: skip


if __name__ == "__main__":
    words = sys.argv[1:] or sys.exit(__doc__)
    try:
        line = Line(words[0], *map(int, words[1:3]))
        while time.sleep(0.1) is None:
            try:
                print(line.read())
            except (TimeoutError, ValueError) as error:
                print(error)
    except (OSError, KeyError, ValueError, termios.error) as error:
        sys.exit(
            f"{words[0]}: {error.args[-1]} (a serial port; a rate of {', '.join(map(str, sorted(RATES)[8:]))}; a unit)"
        )
