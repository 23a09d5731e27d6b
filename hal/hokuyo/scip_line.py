"""An open port seen as SCIP: one question at a time, everything else to whoever follows the stream."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

from hal.errors import HalError
from hal.hokuyo.scip import DATA, BadFrame, FrameSplitter, Reply, parse_reply
from hal.port.port import Port

OnFrame = Callable[[bytes, float], None]
_HEARD: Final = 64
_SHOWN: Final = 20


class Line:
    """Frames in, commands out, over one open port.

    Attributes:
        on_frame: gets every frame that is not the reply being waited for, with its arrival time; None: dropped.
        recognised: frames with a valid status line so far; tells a right line rate from a wrong one.
        heard: the first bytes that have come, whatever they were; who empties it gets the next ones.
    """

    def __init__(self, port: Port) -> None:
        self.port = port
        self.on_frame: OnFrame | None = None
        self.recognised = 0
        self.heard = b""
        self._splitter = FrameSplitter()
        self._echo = b""
        self._reply: asyncio.Future[bytes] | None = None
        self._lost: HalError | None = None
        self._on_lost: Callable[[], None] | None = None
        port.start(self._take, self._gone)

    @property
    def dropped_bytes(self) -> int:
        """Bytes that could not be part of any frame."""
        return self._splitter.dropped_bytes

    @property
    def strange(self) -> bool:
        """Whether something talks there and none of it was SCIP."""
        return bool(self.heard) and not self.recognised

    @property
    def lost(self) -> HalError | None:
        """Why the port is gone; None while it is there."""
        return self._lost

    def when_lost(self, call: Callable[[], None] | None) -> None:
        """Have ``call`` called when the port goes, at once if it has gone already; None: nobody."""
        self._on_lost = call
        if call is not None and self._lost is not None:
            call()

    async def ask(self, command: bytes, timeout_s: float) -> bytes:
        """Send a command and wait for the frame that echoes it; data replies (status 99) are none.

        A line feed goes first, which ends whatever half a command somebody else has typed.

        Raises:
            TimeoutError: no reply. HalError: the port is gone or does not take the command.
        """
        if self._lost is not None:
            raise self._lost
        self._echo = command.strip(b"\n")
        self._reply = asyncio.get_running_loop().create_future()
        try:
            self.port.write(b"\n" + command)
            async with asyncio.timeout(timeout_s):
                return await self._reply
        finally:
            self._reply = None

    def close(self) -> None:
        """Close the port."""
        self.on_frame = self._on_lost = None
        self.port.close()

    def _take(self, data: bytes, t_rx: float) -> None:
        if len(self.heard) < _HEARD:
            self.heard = (self.heard + data)[:_HEARD]
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
    """The beginning of what was heard as a person may read it, a dot for each byte that is no letter."""
    return "".join(chr(one) if 32 <= one < 127 else "." for one in data.strip()[:_SHOWN])


def legible(data: bytes) -> float:
    """Share of bytes that are letters: at a wrong line rate hardly any are."""
    return sum(32 <= one < 127 or one in b"\r\n" for one in data) / max(len(data), 1)


def _well_formed(frame: bytes) -> bool:
    return reply_or_none(frame) is not None


def reply_or_none(frame: bytes) -> Reply | None:
    """The frame taken apart, None where it is damaged."""
    try:
        return parse_reply(frame)
    except BadFrame:
        return None
