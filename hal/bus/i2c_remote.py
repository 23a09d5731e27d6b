"""The client of a remote bus (``unix:/path``, ``tcp://host:port``); :mod:`hal.bus.i2c_frames` describes the protocol.

Repeated transactions are ordered one ahead, so that the bus does not wait for this process between two blocks.
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
from hal.bus.i2c import Message, Transferred, check
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError

DEFAULT_TCP_PORT: Final = 10941
CONNECT_S: Final = 2.0
REPLY_S: Final = 4.0
"""Longer than any transaction: 8192 bytes at 100 kHz take 0.74 s, an adapter's time-out 1 s, one is ordered ahead."""
_START: Final = "start the bus server: python -m hal.bus.i2c_server BUS "


def clock_name() -> str:
    """Equal in two processes if and only if they read the same CLOCK_MONOTONIC; empty where that cannot be told."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {Path('/proc/self/ns/time').readlink()}"
    except OSError:
        return ""


class RemoteClock:
    """Translates the server's clock to ours.

    Every exchange bounds the difference from both sides: what we sent cannot arrive before it was sent, nor its answer.
    The best of the latest bounds are kept for ``WINDOW`` exchanges, in which clocks drift apart by microseconds; bounds
    that contradict each other show that one clock has been stepped, and only the latest count.
    """

    WINDOW: Final = 64
    TOLERANCE_S: Final = 1e-3

    def __init__(self, same: bool) -> None:
        self._same = same
        self._low: deque[float] = deque(maxlen=self.WINDOW)
        self._high: deque[float] = deque(maxlen=self.WINDOW)

    def learn(self, ordered: float, received: float, sent: float, answered: float) -> None:
        """One exchange: our times of order and answer, the server's of the same two frames.

        Raises:
            BadFrame: it says that it reads our clock, but not these times.
        """
        low, high = sent - answered, received - ordered
        if self._same and (low > self.TOLERANCE_S or high < -self.TOLERANCE_S):
            raise frames.BadFrame("times from before the order or after the answer")
        if self._low and (low > min(self._high) + self.TOLERANCE_S or high < max(self._low) - self.TOLERANCE_S):
            self._low.clear()
            self._high.clear()
        self._low.append(low)
        self._high.append(high)

    def ours(self, theirs: float) -> float:
        """A time of the server in our clock."""
        if self._same or not self._low:
            return theirs
        return theirs - 0.5 * (max(self._low) + min(self._high))


@dataclass(slots=True)
class _Order:
    """A transaction that has been ordered: when, bytes of its reads, and whether anybody still wants its answer."""

    t: float
    lengths: tuple[int, ...]
    wanted: bool = True

    def check(self, answer: frames.Done) -> None:
        if answer.errno:
            return
        got = tuple(map(len, answer.reads))
        if len(got) != len(self.lengths) or any(n > asked for n, asked in zip(got, self.lengths, strict=True)):
            raise frames.BadFrame(f"reads of {got} bytes where {self.lengths} were ordered")


class RemoteBus:
    """An open connection to a bus server; see :class:`hal.bus.i2c.Bus`. Made by `open_remote`. Not thread-safe."""

    def __init__(self, name: str, link: socket.socket) -> None:
        """Wait for the server's greeting; raises `HalError` where there is none."""
        self._name = name
        self._link: socket.socket | None = link
        self._splitter = frames.Splitter()
        self._inbox: deque[tuple[int, bytes]] = deque()
        self._ordered: dict[int, _Order] = {}
        self._early: dict[int, frames.Done] = {}
        self._number = 0
        greeting = self._greeting()
        self._about = greeting.about
        self._clock = RemoteClock(same=greeting.clock == clock_name() != "")

    @property
    def name(self) -> str:
        """The bus as the user named it."""
        return self._name

    @property
    def about(self) -> str:
        """What the adapter at the other end calls itself."""
        return self._about

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction; raises `OSError`, ENODEV where the connection is lost."""
        return self._collect(self._order(messages))

    def repeat(self, messages: tuple[Message, ...]) -> Generator[Transferred]:
        """The same transaction again and again, one ordered ahead."""
        ahead = [self._order(messages)]
        try:
            while True:
                ahead.append(self._order(messages))
                yield self._collect(ahead.pop(0))
        finally:
            for number in ahead:  # their answers are thrown away when they come
                self._early.pop(number, None)
                if number in self._ordered:
                    self._ordered[number].wanted = False

    def release(self) -> None:
        """Hang up: the server gives the bus up then, and who waits here for an answer is told that there is none."""
        if (link := self._link) is not None:
            with contextlib.suppress(OSError):  # it has been closed meanwhile
                link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _order(self, messages: tuple[Message, ...]) -> int:
        check(messages)
        self._number = (self._number + 1) & 0xFFFFFFFF
        lengths = tuple(message.length for message in messages if message.length)
        self._ordered[self._number] = _Order(time.monotonic(), lengths)
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
        return Transferred(self._clock.ours(done.t0), self._clock.ours(done.t1), done.reads)

    def _answer(self) -> frames.Done | None:
        """The next answer; None for one that nobody wants any more."""
        kind, body = self._frame()
        answered = time.monotonic()
        try:
            if kind != frames.DONE:
                raise frames.BadFrame(f"a frame of kind {kind} instead of an answer")
            answer = frames.parse_done(body)
            order = self._ordered.pop(answer.number, None)
            if order is None:
                raise frames.BadFrame(f"an answer to an order {answer.number} that there is not")
            order.check(answer)
            self._clock.learn(order.t, answer.received, answer.sent, answered)
            return answer if order.wanted else None
        except frames.BadFrame as error:
            raise self._lost(OSError(errno.EPROTO, f"the bus server sent {error}")) from error

    def _greeting(self) -> frames.Hello:
        try:
            kind, body = self._frame()
            if kind == frames.REFUSED:
                raise frames.parse_refused(body, self._name)
            if kind != frames.HELLO:
                raise frames.BadFrame("this is no I2C bus server")
            return frames.parse_hello(body)
        except frames.BadFrame as error:
            self.close()
            raise self._no_server(error) from error
        except OSError as error:
            self.close()
            if error.errno == errno.EPROTO:
                raise self._no_server(error.strerror) from error
            problem = f"no greeting: {error.strerror or error}"
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
        """Close, for nothing that still comes can be relied on; what to raise."""
        self.close()
        self._ordered.clear()
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
        DeviceMissing: no server there, or no bus behind it. DeviceRefused: not a bus server, or a bus not for us.
        DeviceFault: a server that does not answer.
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
        return DeviceMissing(name, "no bus server there", _START + name)
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceRefused(name, "permission denied", "the socket's mode must let this user read and write it")
    if error.errno in (errno.EPROTOTYPE, errno.ENOTSOCK):
        return DeviceRefused(name, "not a stream socket", "name the bus server's own socket")
    if isinstance(error, TimeoutError):
        return DeviceMissing(name, f"no answer within {CONNECT_S:g} s", "check network, address and port")
    return DeviceMissing(name, os.strerror(error.errno) if error.errno else str(error), "check network and address")
