"""SCIP over an open port: one command and its reply at a time; all other frames go to the stream's receiver."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

from hal.errors import HalError
from hal.hokuyo.scip import DATA, BadFrame, FrameSplitter, Reply, parse_reply
from hal.port.port import Port

OnFrame = Callable[[bytes, float], None]
_FIRST_BYTES: Final = 64
_SHOWN: Final = 20


class Line:
    """Frames in, commands out, over one open port.

    Attributes:
        on_frame: receives every frame but the awaited reply, with its arrival time; None: dropped.
        recognised: frames with a valid status line so far; distinguishes a right line rate from a wrong one.
        first_bytes: the first bytes received, valid or not; collected again after it was emptied.
    """

    def __init__(self, port: Port) -> None:
        self.port = port
        self.on_frame: OnFrame | None = None
        self.recognised = 0
        self.first_bytes = b""
        self._splitter = FrameSplitter()
        self._echo = b""
        self._reply: asyncio.Future[bytes] | None = None
        self._lost: HalError | None = None
        self._on_lost: Callable[[], None] | None = None
        port.start(self._receive, self._gone)

    @property
    def dropped_bytes(self) -> int:
        """Bytes that could not be part of any frame."""
        return self._splitter.dropped_bytes

    @property
    def is_foreign(self) -> bool:
        """Whether bytes arrive and none of them were SCIP."""
        return bool(self.first_bytes) and not self.recognised

    @property
    def lost(self) -> HalError | None:
        """The error that ended the port; None while it is open."""
        return self._lost

    def set_on_lost(self, call: Callable[[], None] | None) -> None:
        """Set the callback for the loss of the port, called at once if it is lost already; None removes it."""
        self._on_lost = call
        if call is not None and self._lost is not None:
            call()

    async def exchange(self, command: bytes, timeout_s: float) -> bytes:
        """Send a command and wait for the frame that echoes it; data replies (status 99) do not count.

        A line feed goes first and ends an incomplete earlier command.

        Raises:
            TimeoutError: no reply. HalError: the port is gone or does not accept the command.
        """
        if self._lost is not None:
            raise self._lost
        self._echo = command.strip(b"\n")
        reply: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._reply = reply
        try:
            self.port.write(b"\n" + command)
            # asyncio.timeout() of Python 3.11.2 raises CancelledError where the task has been cancelled before
            await asyncio.wait({reply}, timeout=timeout_s)
            if not reply.done():
                raise TimeoutError
            return reply.result()
        finally:
            self._reply = None

    def close(self) -> None:
        """Close the port."""
        self.on_frame = self._on_lost = None
        self.port.close()

    def _receive(self, data: bytes, t_rx: float) -> None:
        if len(self.first_bytes) < _FIRST_BYTES:
            self.first_bytes = (self.first_bytes + data)[:_FIRST_BYTES]
        for frame in self._splitter.feed(data):
            if self._answers(frame):
                assert self._reply is not None
                self._reply.set_result(frame)
            elif self.on_frame is not None:
                self.on_frame(frame, t_rx)
            elif _well_formed(frame):
                self.recognised += 1

    def _answers(self, frame: bytes) -> bool:
        if self._reply is None or self._reply.done() or not frame.startswith(self._echo + b"\n"):
            return False
        self.recognised += 1
        return frame[len(self._echo) + 1 : len(self._echo) + 3] != DATA.encode()

    def _gone(self, error: HalError) -> None:
        self._lost = error
        if self._reply is not None and not self._reply.done():
            self._reply.set_exception(error)
        if self._on_lost is not None:
            self._on_lost()


def printable(data: bytes) -> str:
    """The first bytes as readable text, a dot for each unprintable byte."""
    return "".join(chr(one) if 32 <= one < 127 else "." for one in data.strip()[:_SHOWN])


def legible(data: bytes) -> float:
    """Share of printable bytes: at a wrong line rate it is small."""
    return sum(32 <= one < 127 or one in b"\r\n" for one in data) / max(len(data), 1)


def _well_formed(frame: bytes) -> bool:
    return reply_or_none(frame) is not None


def reply_or_none(frame: bytes) -> Reply | None:
    """The parsed frame; None where it is damaged."""
    try:
        return parse_reply(frame)
    except BadFrame:
        return None
