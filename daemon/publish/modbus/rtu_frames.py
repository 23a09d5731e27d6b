"""Modbus RTU framing: extracts requests from a stream of bytes and encodes replies. Pure: no line, no clock.

A request has no start mark, and a USB adapter does not pass on the silence at its end. A request therefore starts with
our unit (or 0, a broadcast), has the length that its function defines, and ends with the right CRC-16. Everything else
is skipped byte by byte: noise, other devices' requests, and their replies.
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
"""Offset of the byte count in a request, by function; that many bytes follow, and the CRC."""


def framed(unit: int, body: bytes) -> bytes:
    """RTU message with unit and CRC around a function's body."""
    frame = bytes([unit]) + body
    return frame + FramerRTU.compute_CRC(frame).to_bytes(_CRC, "big")


def _size(data: bytearray, at: int) -> int:
    """Size of the request that may start here; 0: too few bytes to decide, -1: none starts here."""
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
    """Collects the bytes of a line and extracts the requests for this unit.

    Args:
        unit: our address on the line.

    Attributes:
        skipped: bytes that belonged to no request of ours.
    """

    def __init__(self, unit: int) -> None:
        self.skipped = 0
        self._unit = unit
        self._data = bytearray()
        self._open: list[int] = []  # possible starts of incomplete requests
        self._next = 0  # first position that has not been examined

    def forget(self) -> None:
        """Discard the collected bytes: the line was silent, so no request is still on its way."""
        self._skip(len(self._data))

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Requests that these bytes complete: unit as addressed, and the function's body.

        Each position is examined once, when the whole request that may start at it has arrived.
        """
        self._data += data
        found: list[tuple[int, bytes]] = []
        while (frame := self._first()) is not None:
            at, size = frame
            found.append((self._data[at], bytes(self._data[at + 1 : at + size - _CRC])))
            self.skipped -= size
            self._skip(at + size)
        keep = self._open[0] if self._open else len(self._data)
        self._skip(max(keep, len(self._data) - MAX_FRAME))
        return found

    def _first(self) -> tuple[int, int] | None:
        """Position and size of the first complete request; positions that need no second look are discarded."""
        waiting, self._open = self._open, []
        while waiting or self._next < len(self._data):
            if waiting:
                at = waiting.pop(0)
            else:
                at, self._next = self._next, self._next + 1
            size = _size(self._data, at) if self._data[at] in (self._unit, BROADCAST) else -1
            if size == 0 or at + size > len(self._data):
                self._open.append(at)
            elif size >= _SHORTEST and self._good(at, size):
                self._open += waiting
                return at, size
        return None

    def _skip(self, count: int) -> None:
        """Discard bytes that cannot be part of a request any more."""
        self.skipped += count
        del self._data[:count]
        self._open = [at - count for at in self._open if at >= count]
        self._next = max(self._next - count, 0)

    def _good(self, at: int, size: int) -> bool:
        end = at + size - _CRC
        return FramerRTU.compute_CRC(bytes(self._data[at:end])) == int.from_bytes(self._data[end : end + _CRC], "big")
