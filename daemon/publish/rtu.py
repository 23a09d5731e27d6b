"""Modbus RTU on a serial line: the same tables as on UDP and TCP, and one client, the line's master.

* An answer goes out 3.5 characters after its request at the earliest, as the standard asks: a half-duplex master needs
  that time to let the line go.
* What the line sends back of our own answers (adapters with echo) is no request.
* Nothing waits: an answer that the line does not take is dropped, and the line is opened anew.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final, Protocol

from daemon.endpoints import RtuLine
from daemon.publish.rtu_frames import BROADCAST, RtuFrames, framed
from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.port import Port

SILENCE_S: Final = 0.05
"""Without a byte for so long, a request that has begun does not end any more; USB adapters pause for up to 16 ms."""
ECHO_S: Final = 0.005
"""Our own answer may come back this long after its last bit; no master asks again that soon."""
_FAST: Final = 19200
_FAST_GAP_S: Final = 0.00175
_CHARACTER: Final = 11.0  # bits

Answer = Callable[[bytes], bytes]
"""Body of a request to the body of its answer."""


class LineOpener(Protocol):
    """Opens a serial line with its character format."""

    def __call__(self, device: str, baud: int, *, style: str) -> Awaitable[Port]:
        """Raises `DeviceMissing`, `DeviceRefused`."""
        ...


async def open_line(device: str, baud: int, *, style: str) -> Port:
    """A real line; pyserial is imported only here. Raises `DeviceMissing`, `DeviceRefused`."""
    from hal.serial_port import NOT_SERIAL, open_serial_port

    try:
        return await open_serial_port(device, baud, style=style)
    except DeviceMissing as error:
        remedy = "plug the adapter in, or correct `modbus.serial`; it is opened by itself once it is there"
        raise DeviceMissing(device, error.problem, remedy) from error
    except DeviceRefused as error:
        if error.problem != NOT_SERIAL:
            raise
        remedy = "name the adapter's own device file in `modbus.serial`, such as /dev/ttyUSB1"
        raise DeviceRefused(device, error.problem, remedy) from error


class RtuServer:
    """Serves one line.

    Args:
        line: which, and our unit. answer: makes the answer's body.
        opener: opens it.

    Attributes:
        requests, unsent: answered, and answers that the line did not take.
    """

    def __init__(self, line: RtuLine, answer: Answer, opener: LineOpener = open_line) -> None:
        self.requests = self.unsent = 0
        self.frames = RtuFrames(line.unit)
        self._line = line
        self._answer = answer
        self._opener = opener
        self._port: Port | None = None
        self._heard = 0.0
        self._sent = b""
        self._echo_until = 0.0
        self._going: asyncio.TimerHandle | None = None

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            HalError: the line cannot be opened, or has gone.
        """
        lost: asyncio.Future[HalError] = asyncio.get_running_loop().create_future()
        self._port = await self._opener(self._line.path, self._line.baud, style=self._line.format)
        try:
            self._port.start(self._take, lost.set_result)
            raise await lost
        finally:
            if self._going is not None:
                self._going.cancel()
            self.frames.forget()
            self._port.close()
            self._port = None

    def _take(self, data: bytes, t_rx: float) -> None:
        if t_rx - self._heard > SILENCE_S:
            self.frames.forget()
        self._heard = t_rx
        for unit, body in self.frames.take(data):
            if t_rx <= self._echo_until and framed(unit, body) == self._sent:
                continue  # the answer to a write of one register is its request again
            self.requests += 1
            answer = self._answer(body)
            if unit != BROADCAST:
                self._send_soon(framed(unit, answer))

    def _send_soon(self, frame: bytes) -> None:
        """Once the master has let the line go; it waits for no more than one answer."""
        if self._going is not None:
            self._going.cancel()
        gap = _FAST_GAP_S if self._line.baud > _FAST else 3.5 * _CHARACTER / self._line.baud
        self._going = asyncio.get_running_loop().call_later(gap, self._send, frame)

    def _send(self, frame: bytes) -> None:
        self._going = None
        if self._port is None:
            return
        try:
            self._port.write(frame)
        except HalError:
            self.unsent += 1  # a line that is gone tells so itself
            return
        self._sent = frame
        now = asyncio.get_running_loop().time()
        self._echo_until = now + _CHARACTER * len(frame) / self._line.baud + ECHO_S
