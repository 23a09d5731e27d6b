"""Client of a remote I2C bus (``unix:/path``, ``tcp://host:port``); the protocol is in :mod:`hal.bus.i2c_frames`.

The first bus that uses an address claims it until it is closed, as on a local bus (:mod:`hal.bus.address_lock`). A
repeated transaction is sent one ahead, so that the bus does not wait for this process between two blocks.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import time
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from hal.bus import i2c_frames as frames
from hal.bus.address_lock import AddressLocks
from hal.bus.i2c import Message, Transferred, check
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError

DEFAULT_TCP_PORT: Final = 10941
CONNECT_S: Final = 2.0
REPLY_S: Final = 4.0
"""Longer than any transaction: 8192 bytes at 100 kHz take 0.74 s, an adapter's time-out 1 s, one more is queued."""
_START: Final = "start the bus server: python -m hal.bus.i2c_server BUS "


def clock_name() -> str:
    """Text that is equal in two processes if and only if they read the same CLOCK_MONOTONIC; empty where unknown."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {Path('/proc/self/ns/time').readlink()}"
    except OSError:
        return ""


class RemoteClock:
    """Converts times of the server's clock to this computer's.

    Each exchange bounds the offset from both sides: neither request nor answer arrives before it was sent. The tightest
    bounds of the last ``WINDOW`` exchanges are used; clocks drift by microseconds in that time. Contradicting bounds
    mean that a clock was stepped: all older ones are then dropped.
    """

    WINDOW: Final = 64
    TOLERANCE_S: Final = 1e-3

    def __init__(self, same: bool) -> None:
        self._same = same
        self._low: deque[float] = deque(maxlen=self.WINDOW)
        self._high: deque[float] = deque(maxlen=self.WINDOW)

    def add(self, ordered: float, received: float, sent: float, answered: float) -> None:
        """Add one exchange: our times of request and answer, the server's times of the same two frames (s).

        Raises:
            BadFrame: the server claims our clock, but its times contradict it.
        """
        low, high = sent - answered, received - ordered
        if self._same and (low > self.TOLERANCE_S or high < -self.TOLERANCE_S):
            raise frames.BadFrame("times before the request or after the reply")
        if self._low and (low > min(self._high) + self.TOLERANCE_S or high < max(self._low) - self.TOLERANCE_S):
            self._low.clear()
            self._high.clear()
        self._low.append(low)
        self._high.append(high)

    def to_local(self, theirs: float) -> float:
        """Convert a time of the server to our clock (s)."""
        if self._same or not self._low:
            return theirs
        return theirs - 0.5 * (max(self._low) + min(self._high))


@dataclass(slots=True)
class _Request:
    """A pending transaction: time of the request, bytes of its reads, whether the answer is still wanted."""

    t: float
    lengths: tuple[int, ...]
    wanted: bool = True

    def check(self, answer: frames.Done) -> None:
        if answer.errno:
            return
        got = tuple(map(len, answer.reads))
        if len(got) != len(self.lengths) or any(n > limit for n, limit in zip(got, self.lengths, strict=True)):
            raise frames.BadFrame(f"reads of {got} bytes where {self.lengths} were requested")


class RemoteBus:
    """An open connection to a bus server; see :class:`hal.bus.i2c.Bus`. Made by `open_remote`. Not thread-safe."""

    def __init__(self, name: str, link: socket.socket) -> None:
        """Receive the server's greeting; raises `HalError` where none comes."""
        self._name = name
        self._link: socket.socket | None = link
        self._splitter = frames.Splitter()
        self._inbox: deque[tuple[int, bytes]] = deque()
        self._pending: dict[int, _Request] = {}
        self._early: dict[int, frames.Done] = {}
        self._number = 0
        self._locks = AddressLocks(name)
        greeting = self._greeting()
        self._about = greeting.about
        self._clock = RemoteClock(same=greeting.clock == clock_name() != "")

    @property
    def name(self) -> str:
        """The bus as the user named it."""
        return self._name

    @property
    def about(self) -> str:
        """The own name of the adapter at the server."""
        return self._about

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction; raises `OSError`, ENODEV where the connection is lost."""
        return self._collect(self._send(messages))

    def repeat(self, messages: tuple[Message, ...]) -> Generator[Transferred]:
        """Repeat the transaction, one request ahead."""
        ahead = [self._send(messages)]
        try:
            while True:
                ahead.append(self._send(messages))
                yield self._collect(ahead.pop(0))
        finally:
            for number in ahead:  # their answers are dropped on arrival
                self._early.pop(number, None)
                if number in self._pending:
                    self._pending[number].wanted = False

    def release(self) -> None:
        """Shut the connection down: the server releases the bus, and a pending read here fails."""
        self._locks.release()
        if (link := self._link) is not None:
            with contextlib.suppress(OSError):  # it has been closed meanwhile
                link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection."""
        self._locks.release()
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _send(self, messages: tuple[Message, ...]) -> int:
        check(messages)
        for message in messages:
            self._locks.claim(message.address)
        self._number = (self._number + 1) & 0xFFFFFFFF
        lengths = tuple(message.length for message in messages if message.length)
        self._pending[self._number] = _Request(time.monotonic(), lengths)
        try:
            self._open_link().sendall(frames.transfer(self._number, messages))
        except OSError as error:
            raise self._lost(error) from error
        return self._number

    def _collect(self, number: int) -> Transferred:
        done = self._early.pop(number, None)
        while done is None:
            answer = self._answer()
            if answer is not None and answer.number == number:
                done = answer
            elif answer is not None:
                self._early[answer.number] = answer
        if done.errno:
            raise OSError(done.errno, os.strerror(done.errno))
        return Transferred(self._clock.to_local(done.t0), self._clock.to_local(done.t1), done.reads)

    def _answer(self) -> frames.Done | None:
        """The next answer; None for one that is no longer wanted."""
        kind, body = self._frame()
        answered = time.monotonic()
        try:
            if kind != frames.DONE:
                raise frames.BadFrame(f"a message of kind {kind} instead of a reply")
            answer = frames.parse_done(body)
            request = self._pending.pop(answer.number, None)
            if request is None:
                raise frames.BadFrame(f"a reply to request {answer.number}, which was not sent")
            request.check(answer)
            self._clock.add(request.t, answer.received, answer.sent, answered)
            return answer if request.wanted else None
        except frames.BadFrame as error:
            raise self._lost(OSError(errno.EPROTO, f"the bus server sent {error}")) from error

    def _greeting(self) -> frames.Hello:
        try:
            kind, body = self._frame()
            if kind == frames.REFUSED:
                raise frames.parse_refused(body, self._name)
            if kind != frames.HELLO:
                raise frames.BadFrame("this is not an I2C bus server")
            return frames.parse_hello(body)
        except frames.BadFrame as error:
            self.close()
            raise self._no_server(error) from error
        except OSError as error:
            self.close()
            if error.errno == errno.EPROTO:
                raise self._no_server(error.strerror) from error
            problem = f"no hello message: {error.strerror or error}"
            raise DeviceFault(self._name, problem, "restart the bus server") from error
        except HalError:
            self.close()
            raise

    def _no_server(self, why: object) -> HalError:
        return DeviceRefused(self._name, f"not an I2C bus server: {why}", "check the address")

    def _frame(self) -> tuple[int, bytes]:
        while not self._inbox:
            try:
                data = self._open_link().recv(1 << 17)
                if not data:
                    raise OSError(errno.ENODEV, "the bus server has closed the connection")
                self._inbox += self._splitter.feed(data)
            except TimeoutError as error:
                raise self._lost(OSError(errno.ETIMEDOUT, "the bus server does not answer")) from error
            except frames.BadFrame as error:
                raise self._lost(OSError(errno.EPROTO, f"the bus server sent {error}")) from error
            except OSError as error:
                raise self._lost(error) from error
        return self._inbox.popleft()

    def _open_link(self) -> socket.socket:
        if self._link is None:
            raise OSError(errno.ENODEV, "the connection to the bus server is closed")
        return self._link

    def _lost(self, error: OSError) -> OSError:
        """Close the connection, whose further data cannot be trusted; return the error to raise."""
        self.close()
        self._pending.clear()
        if error.errno in (errno.ETIMEDOUT, errno.EPROTO, errno.ENODEV):
            return error
        if isinstance(error, ConnectionError):
            return OSError(errno.ENODEV, "the bus server has closed the connection")
        return OSError(errno.ENODEV, f"the connection to the bus server is lost: {error.strerror or error}")


def parse_address(name: str) -> str | tuple[str, int]:
    """Path of ``unix:/path``, or host and port of ``tcp://host[:port]``; raises `DeviceRefused` for anything else."""
    if name.startswith("unix:") and len(name) > len("unix:"):
        return name.removeprefix("unix:")
    try:
        parts = urlsplit(name)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or not name.startswith("tcp://"):
        raise DeviceRefused(name, "not the address of a bus server", "expected unix:/path or tcp://host:port")
    return str(host), DEFAULT_TCP_PORT if port is None else port


def open_remote(name: str) -> RemoteBus:
    """Connect to a bus server within 2 s and wait for its greeting.

    Raises:
        DeviceMissing: no server, or no bus behind it. DeviceRefused: not a bus server, or no permission for the bus.
        DeviceFault: the server does not answer.
    """
    address = parse_address(name)
    link: socket.socket | None = None
    try:
        if isinstance(address, str):
            link = socket.socket(socket.AF_UNIX)
            link.settimeout(CONNECT_S)
            link.connect(address)
        else:
            link = socket.create_connection(address, CONNECT_S)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.settimeout(REPLY_S)
    except UnicodeError as error:
        raise DeviceMissing(name, "not a host name", "name the host by its IP address") from error
    except OSError as error:
        if link is not None:
            link.close()
        raise _explain(name, error) from error
    return RemoteBus(name, link)


def _explain(name: str, error: OSError) -> HalError:
    if isinstance(error, socket.gaierror):
        return DeviceMissing(name, "host name is not known", "name the host by its IP address")
    if error.errno in (errno.ENOENT, errno.ECONNREFUSED):
        return DeviceMissing(name, "no bus server runs there", _START + name)
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceRefused(name, "permission denied", "give this user read and write access to the socket")
    if error.errno in (errno.EPROTOTYPE, errno.ENOTSOCK):
        return DeviceRefused(name, "not a stream socket", "name the socket of the bus server")
    if isinstance(error, TimeoutError):
        return DeviceMissing(name, f"no answer within {CONNECT_S:g} s", "check network, address and port")
    return DeviceMissing(name, os.strerror(error.errno) if error.errno else str(error), "check network and address")
