"""Wire protocol of the remote I2C bus (unix or TCP socket). Pure codec, no I/O.

All integers are big-endian, times are IEEE doubles in seconds. A frame is ``u32 length, u8 kind, body`` where
``length`` counts kind and body. A connection begins with one frame of the server, HELLO or REFUSED; after that the
client sends TRANSFER and the server answers each with DONE, in order. A client may send ahead: the bus then does not
wait for the client between transactions. A receiver of a malformed frame closes the connection.

=========  ====  ==========================================================================================
frame      kind  body
=========  ====  ==========================================================================================
HELLO      1     ``u32 0x4C493243 ("LI2C"), u8 version = 1, f64 now``; then the server's clock and the
                 adapter's own name, both as ``u16 length, UTF-8``
REFUSED    2     ``u8 error`` (1 missing, 2 refused, 3 fault); then problem and remedy, ``u16 length, UTF-8``
TRANSFER   3     ``u32 number, u8 messages``; for each ``u8 address, u8 flags`` (1: read), ``u16 length``,
                 and the bytes if it is a write
DONE       4     ``u32 number, u16 errno`` (0: done), f64 received, f64 t0, f64 t1, f64 sent, u8 reads``;
                 for each read ``u16 length, bytes``
=========  ====  ==========================================================================================

``received, t0, t1, sent`` are the server's CLOCK_MONOTONIC. Its *clock* is a text that is equal on both sides if and
only if both read the same CLOCK_MONOTONIC; if it differs, the client estimates the offset from the four times.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite
from typing import Any, Final

from hal.bus.i2c import MAX_LENGTH, MAX_MESSAGES, Message
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError

MAGIC: Final = 0x4C493243
VERSION: Final = 1
HELLO: Final = 1
REFUSED: Final = 2
TRANSFER: Final = 3
DONE: Final = 4
MAX_FRAME: Final = 64 + MAX_MESSAGES * (4 + MAX_LENGTH)
ERRORS: Final[dict[int, type[HalError]]] = {1: DeviceMissing, 2: DeviceRefused, 3: DeviceFault}

_HEAD: Final = struct.Struct(">IB")
_HELLO: Final = struct.Struct(">IBd")
_TRANSFER: Final = struct.Struct(">IB")
_MESSAGE: Final = struct.Struct(">BBH")
_DONE: Final = struct.Struct(">IHddddB")
_SHORT: Final = struct.Struct(">H")


class BadFrame(ValueError):
    """Bytes that are not a frame of this protocol."""


@dataclass(frozen=True, slots=True)
class Hello:
    """The server's greeting: its time (s), the identity of its clock, and the adapter's own name."""

    now: float
    clock: str
    about: str


@dataclass(frozen=True, slots=True)
class Done:
    """The result of a transaction; times are the server's. ``errno`` 0: success."""

    number: int
    errno: int
    received: float
    t0: float
    t1: float
    sent: float
    reads: tuple[bytes, ...]


class Splitter:
    """Cuts a byte stream into frames."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Append bytes; return the complete frames as kind and body. Raises `BadFrame` for a wrong length."""
        self._bytes += data
        frames: list[tuple[int, bytes]] = []
        while len(self._bytes) >= _HEAD.size:
            length, kind = _HEAD.unpack_from(self._bytes)
            if not 1 <= length <= MAX_FRAME:
                raise BadFrame(f"a message of {length} bytes")
            end = 4 + length
            if len(self._bytes) < end:
                break
            frames.append((kind, bytes(self._bytes[_HEAD.size : end])))
            del self._bytes[:end]
        return frames


class _Reader:
    """Parses a body; a read beyond its end, and bytes left over, raise `BadFrame`."""

    def __init__(self, body: bytes) -> None:
        self._body, self._at = body, 0

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        end = self._at + layout.size
        if end > len(self._body):
            raise BadFrame("a body that is too short")
        values = layout.unpack_from(self._body, self._at)
        self._at = end
        return values

    def read(self, length: int) -> bytes:
        data = self._body[self._at : self._at + length]
        if len(data) < length:
            raise BadFrame("a body that is too short")
        self._at += length
        return data

    def counted(self) -> bytes:
        (length,) = self.unpack(_SHORT)
        return self.read(length)

    def text(self) -> str:
        try:
            return self.counted().decode("utf-8")
        except UnicodeDecodeError as error:
            raise BadFrame("a text that is not UTF-8") from error

    def end(self) -> None:
        if self._at != len(self._body):
            raise BadFrame("a body that is too long")


def frame(kind: int, body: bytes) -> bytes:
    """A frame on the wire."""
    return _HEAD.pack(1 + len(body), kind) + body


def _counted(data: bytes) -> bytes:
    return _SHORT.pack(len(data)) + data


def _text(text: str) -> bytes:
    return _counted(text.encode("utf-8")[:1000].decode("utf-8", "ignore").encode("utf-8"))


def hello(now: float, clock: str, about: str) -> bytes:
    """The frame with which a server greets; texts are cut to 1000 bytes."""
    return frame(HELLO, _HELLO.pack(MAGIC, VERSION, now) + _text(clock) + _text(about))


def parse_hello(body: bytes) -> Hello:
    """Read a HELLO; raises `BadFrame`."""
    reader = _Reader(body)
    magic, version, now = reader.unpack(_HELLO)
    if magic != MAGIC:
        raise BadFrame("this is not an I2C bus server")
    if version != VERSION:
        raise BadFrame(f"the peer has version {version} of the protocol; this side has version {VERSION}")
    parsed = Hello(now, reader.text(), reader.text())
    reader.end()
    _check_times(now)
    return parsed


def refused(error: HalError) -> bytes:
    """The REFUSED frame of an error."""
    kind = next((code for code, cls in ERRORS.items() if isinstance(error, cls)), 3)
    return frame(REFUSED, bytes([kind]) + _text(error.problem) + _text(error.remedy))


def parse_refused(body: bytes, device: str) -> HalError:
    """Parse a REFUSED frame to the error of ``device``; raises `BadFrame`."""
    reader = _Reader(body)
    kind = ERRORS.get(reader.read(1)[0])
    if kind is None:
        raise BadFrame("an unknown kind of error")
    error = kind(device, reader.text(), reader.text())
    reader.end()
    return error


def transfer(number: int, messages: tuple[Message, ...]) -> bytes:
    """The frame that orders a transaction."""
    parts = [_TRANSFER.pack(number, len(messages))]
    for message in messages:
        length = len(message.data) or message.length
        parts += [_MESSAGE.pack(message.address, 0 if message.data else 1, length), message.data]
    return frame(TRANSFER, b"".join(parts))


def parse_transfer(body: bytes) -> tuple[int, tuple[Message, ...]]:
    """Read a TRANSFER: its number and messages, of lengths and addresses not yet judged; raises `BadFrame`."""
    reader = _Reader(body)
    number, count = reader.unpack(_TRANSFER)
    messages: list[Message] = []
    for _ in range(count):
        address, flags, length = reader.unpack(_MESSAGE)
        if flags > 1:
            raise BadFrame(f"message flags {flags:#x}")
        messages.append(Message(address, length=length) if flags else Message(address, reader.read(length)))
    reader.end()
    return number, tuple(messages)


def done(answer: Done) -> bytes:
    """The frame that answers a transaction."""
    head = _DONE.pack(
        answer.number, answer.errno, answer.received, answer.t0, answer.t1, answer.sent, len(answer.reads)
    )
    return frame(DONE, head + b"".join(map(_counted, answer.reads)))


def parse_done(body: bytes) -> Done:
    """Read a DONE; raises `BadFrame`."""
    reader = _Reader(body)
    number, errno, received, t0, t1, sent, count = reader.unpack(_DONE)
    reads = tuple(reader.counted() for _ in range(count))
    reader.end()
    _check_times(received, t0, t1, sent)
    return Done(number, errno, received, t0, t1, sent, reads)


def _check_times(*times: float) -> None:
    if not all(isfinite(t) for t in times) or any(b < a for a, b in pairwise(times)):
        raise BadFrame(f"impossible times: {times}")
