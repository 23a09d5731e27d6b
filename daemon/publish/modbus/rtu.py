"""Modbus RTU server on a serial line: the same tables as on UDP and TCP, for one client, the line's master.

* A reply starts 3.5 characters after its request at the earliest, as the standard requires: a half-duplex master needs
that time to release the line.
* An echo of our own replies (adapters with echo) is no request.
* A request that this computer could not process before its master gave up is neither carried out nor replied to: the
reply would collide with the master's next request.
* Nothing waits: a reply that the line does not accept is dropped, and after three in a row the line is opened again.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final, Protocol

from daemon.config.endpoints import RtuLine
from daemon.publish.modbus.rtu_frames import BROADCAST, RtuFrames, framed
from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.port.port import Port

SILENCE_S: Final = 0.05
"""Time in s without a byte after which an incomplete request is discarded; USB adapters pause for up to 16 ms."""
ECHO_S: Final = 0.005
"""Time in s after the last bit of a reply in which its echo may arrive; no master sends a request that soon."""
PATIENCE_S: Final = 0.3
"""Age in s from which a request counts as given up by its master; masters wait for half a second or more."""
TURN_S: Final = 0.05
"""Period in s of the timer that shows that the loop has time for the line."""
STRAY: Final = 2
"""Bytes that a line driver may add where the direction changes; more of them are the master's next request."""
UNSENT: Final = 3
"""Consecutive replies that the line does not accept, after which it is opened again: its adapter is blocked."""
_FAST: Final = 19200
_FAST_GAP_S: Final = 0.00175
_CHARACTER: Final = 11.0  # bits

Answer = Callable[[bytes], bytes]
"""Function from the body of a request to the body of its reply."""


class LineOpener(Protocol):
    """Opens a serial line with its character format."""

    def __call__(self, device: str, baud: int, *, style: str) -> Awaitable[Port]:
        """Raises `DeviceMissing`, `DeviceRefused`."""
        ...


async def open_line(device: str, baud: int, *, style: str) -> Port:
    """Open a real line; pyserial is imported only here. Raises `DeviceMissing`, `DeviceRefused`."""
    from hal.port.serial_port import NOT_SERIAL, open_serial_port

    try:
        return await open_serial_port(device, baud, style=style)
    except DeviceMissing as error:
        remedy = "connect the adapter, or correct `modbus.serial`; the daemon then opens it automatically"
        raise DeviceMissing(device, error.problem, remedy) from error
    except DeviceRefused as error:
        if error.problem != NOT_SERIAL:
            raise
        remedy = "name the device file of the adapter in `modbus.serial`, such as /dev/ttyUSB1"
        raise DeviceRefused(device, error.problem, remedy) from error


class RtuServer:
    """Serves one line.

    Args:
        line: path, format and our unit. answer: makes the reply's body.
        opener: opens the line.

    Attributes:
        requests, unsent: requests served, and replies that the line did not accept. late: given up, for lack of time.
    """

    def __init__(self, line: RtuLine, answer: Answer, opener: LineOpener = open_line) -> None:
        self.requests = self.unsent = self.late = 0
        self.frames = RtuFrames(line.unit)
        self._line = line
        self._answer = answer
        self._opener = opener
        self._port: Port | None = None
        self._lost: asyncio.Future[HalError] | None = None
        self._untaken = 0  # replies in a row
        self._heard = 0.0
        self._sent = b""
        self._echo_until = 0.0
        self._going: asyncio.TimerHandle | None = None
        self._turn: asyncio.TimerHandle | None = None
        self._free = 0.0

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            HalError: the line cannot be opened, is lost, or accepts no replies.
        """
        self._lost, self._untaken = asyncio.get_running_loop().create_future(), 0
        self._port = await self._opener(self._line.path, self._line.baud, style=self._line.format)
        try:
            self._turns()
            self._port.start(self._take, self._end)
            raise await self._lost
        finally:
            for timer in (self._going, self._turn):
                if timer is not None:
                    timer.cancel()
            self.frames.forget()
            self._port.close()
            self._port = None

    def _end(self, error: HalError) -> None:
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(error)

    def _turns(self) -> None:
        """Periodically record that the loop is running: bytes received after this time were not there before."""
        loop = asyncio.get_running_loop()
        self._free = loop.time()
        self._turn = loop.call_later(TURN_S, self._turns)

    def _take(self, data: bytes, t_rx: float) -> None:
        if t_rx - self._heard > SILENCE_S:
            self.frames.forget()
        self._heard = t_rx
        if self._going is not None and len(data) > STRAY:  # the master does not wait for it any more
            self._give_up()
        late = t_rx - self._free > PATIENCE_S
        for unit, body in self.frames.feed(data):
            if t_rx <= self._echo_until and framed(unit, body) == self._sent:
                continue  # the reply to a write of one register equals its request
            if late and unit != BROADCAST:  # a broadcast is neither replied to nor repeated
                self.late += 1
                continue
            self.requests += 1
            answer = self._answer(body)
            if unit != BROADCAST:
                self._send_soon(framed(unit, answer), t_rx)

    def _give_up(self) -> None:
        if self._going is not None:
            self._going.cancel()
            self._going = None
            self.late += 1

    def _send_soon(self, frame: bytes, asked: float) -> None:
        """Send a reply after the gap that the master needs; a newer reply replaces one that waits."""
        self._give_up()
        gap = _FAST_GAP_S if self._line.baud > _FAST else 3.5 * _CHARACTER / self._line.baud
        self._going = asyncio.get_running_loop().call_later(gap, self._send, frame, asked)

    def _send(self, frame: bytes, asked: float) -> None:
        now = asyncio.get_running_loop().time()
        self._going = None
        if self._port is None:
            return
        if now - asked > PATIENCE_S:
            self.late += 1
            return
        try:
            self._port.write(frame)
        except HalError as error:
            self.unsent += 1
            self._untaken += 1
            if self._untaken == UNSENT:
                self._end(error)
            return
        self._untaken = 0
        self._sent = frame
        self._echo_until = now + _CHARACTER * len(frame) / self._line.baud + ECHO_S
