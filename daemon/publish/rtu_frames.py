"""Modbus RTU requests out of a stream of bytes, and answers into it. Pure: no line, no clock.

A request has no mark at its begin, and the silence at its end does not come through a USB adapter. So a request is
what begins with our unit (or 0, which is for all), has the length that its function says, and ends with the right
CRC-16. What is not that is passed over byte by byte: noise, other devices' requests, and their answers.
(MODBUS over Serial Line Specification and Implementation Guide V1.02, 2.5.1.)
"""

from __future__ import annotations

from typing import Final

from pymodbus.framer import FramerRTU

BROADCAST: Final = 0
MAX_FRAME: Final = 256
_CRC: Final = 2
_SHORTEST: Final = 4

_FIXED: Final = {
    1: 8, 2: 8, 3: 8, 4: 8, 5: 8, 6: 8, 7: 4, 8: 8, 11: 4, 12: 4, 17: 4, 22: 10, 24: 6, 43: 7,
}  # fmt: skip
"""Bytes of a request by function, unit and CRC included (MODBUS Application Protocol V1.1b3, chapter 6)."""
_COUNTED: Final = {15: 6, 16: 6, 20: 2, 21: 2, 23: 10}
"""Where the function's request holds its count of bytes; that many follow, and the CRC."""


def framed(unit: int, body: bytes) -> bytes:
    """A frame around a function's body."""
    frame = bytes([unit]) + body
    return frame + FramerRTU.compute_CRC(frame).to_bytes(_CRC, "big")


def _size(data: bytearray, at: int) -> int:
    """Bytes of the request that may begin here; 0: too few are there to tell, -1: none begins here."""
    if at + 1 >= len(data):
        return 0
    function = data[at + 1]
    if fixed := _FIXED.get(function):
        return fixed
    place = _COUNTED.get(function)
    if place is None:
        return -1
    if at + place >= len(data):
        return 0
    size = place + 1 + data[at + place] + _CRC
    return size if size <= MAX_FRAME else -1


class RtuFrames:
    """Collects the bytes of a line and finds the requests that are for us.

    Args:
        unit: our address on the line.

    Attributes:
        skipped: bytes that belonged to no request of ours.
    """

    def __init__(self, unit: int) -> None:
        self.skipped = 0
        self._unit = unit
        self._data = bytearray()

    def forget(self) -> None:
        """Drop what has been collected: the line was silent, so no request is still on its way."""
        self.skipped += len(self._data)
        self._data.clear()

    def take(self, data: bytes) -> list[tuple[int, bytes]]:
        """The requests that are whole with these bytes: unit as addressed, and the function's body."""
        self._data += data
        found: list[tuple[int, bytes]] = []
        at, keep = 0, -1
        while at < len(self._data):
            size = _size(self._data, at) if self._data[at] in (self._unit, BROADCAST) else -1
            if size == 0 or at + size > len(self._data):  # still coming
                keep = at if keep < 0 else keep
            elif size >= _SHORTEST and self._good(at, size):
                found.append((self._data[at], bytes(self._data[at + 1 : at + size - _CRC])))
                self.skipped += at
                del self._data[: at + size]
                at, keep = 0, -1
                continue
            at += 1
        self._drop(len(self._data) if keep < 0 else keep)
        return found

    def _good(self, at: int, size: int) -> bool:
        end = at + size - _CRC
        return FramerRTU.compute_CRC(bytes(self._data[at:end])) == int.from_bytes(self._data[end : end + _CRC], "big")

    def _drop(self, count: int) -> None:
        """Let go of what can be no part of a request any more."""
        count = max(count, len(self._data) - MAX_FRAME)
        self.skipped += count
        del self._data[:count]
