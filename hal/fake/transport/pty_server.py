"""The fake lidar as a serial port of this computer: a pseudo-terminal.

Everything runs on the event loop without threads. When a host does not read, the pty's queue fills up; the sensor then
loses whole replies, which are counted (:attr:`hal.fake.lidar.output_line.OutputCounts.refused_by_host`).
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import select
import struct
import tty
from pathlib import Path

from hal.errors import DeviceRefused
from hal.fake.lidar.device import FakeHokuyo

PTY_POLL_S = 0.02
"""Interval of checks whether a host has opened the pty; Linux has no event for it."""
TCGETS2 = 0x802C542A
TERMIOS2 = struct.Struct("4I20B2I")
"""``struct termios2`` of Linux (asm-generic): flags, line discipline and characters, input and output speed."""


class PtyServer:
    """The device as a serial port: a pty, found by a symbolic link that survives unplugging.

    The sensor notices neither the opening nor the closing of the port: it streams on. Unplugging closes the pty and
    removes the link; plugging in makes a new pty behind the same link.

    Args:
        device: the sensor.
        link: path of the symbolic link; a stale link there is replaced, anything else is refused.
    """

    def __init__(self, device: FakeHokuyo, link: Path | None = None) -> None:
        self._device, self._link = device, link
        self._loop = asyncio.get_running_loop()
        self._master = -1
        self._path = ""
        self._rest = b""
        self._has_host = False
        self._timer: asyncio.TimerHandle | None = None
        if link is not None and link.exists() and not link.is_symlink():
            raise DeviceRefused(str(link), "the path exists and is not a symbolic link", "choose another path")
        device.on_reachable(self._reachable)
        self._reachable(device.reachable)

    @property
    def path(self) -> str:
        """Path for the host: the link, or the pty itself; empty while unplugged."""
        return str(self._link) if self._link is not None else self._path

    def accept(self, data: bytes) -> bool:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        if self._rest:
            return False
        return self._write(data)

    def baud(self) -> int:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        raw = fcntl.ioctl(self._master, TCGETS2, bytes(TERMIOS2.size))
        return int(TERMIOS2.unpack(raw)[-1])

    def hang_up(self) -> None:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        self._device.detach()
        self._shut()

    def close(self) -> None:
        """Unplug for good."""
        self._shut()
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def _reachable(self, reachable: bool) -> None:
        if reachable:
            self._open()
        else:
            self.close()

    def _open(self) -> None:
        self._shut()
        self._master, slave = os.openpty()
        self._path = os.ttyname(slave)
        tty.setraw(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self._path)
        self._poll_host()

    def _shut(self) -> None:
        if self._master < 0:
            return
        self._forget_host()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        os.close(self._master)
        self._master, self._path = -1, ""

    def _poll_host(self) -> None:
        """Check whether a host has opened the slave: until then the master reports a hang-up."""
        poll = select.poll()
        poll.register(self._master, 0)
        if poll.poll(0):
            self._timer = self._loop.call_later(PTY_POLL_S, self._poll_host)
            return
        self._timer = None
        tty.setraw(self._master)  # applies to the slave: no echo, before the host sets it
        self._has_host = True
        self._loop.add_reader(self._master, self._read)
        self._device.attach(self)

    def _forget_host(self) -> None:
        if self._has_host:
            self._has_host = False
            self._rest = b""
            self._loop.remove_reader(self._master)
            self._loop.remove_writer(self._master)

    def _read(self) -> None:
        try:
            data = os.read(self._master, 4096)
        except BlockingIOError:
            return
        except OSError:  # EIO: the last host has closed the slave
            self._forget_host()
            self._device.detach()
            self._poll_host()
            return
        self._device.receive(data)

    def _write(self, data: bytes) -> bool:
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            return False
        except OSError:  # EIO: closed meanwhile, handled in `_read`
            return False
        self._rest = data[written:]
        if self._rest:
            self._loop.add_writer(self._master, self._flush)
        return True

    def _flush(self) -> None:
        self._loop.remove_writer(self._master)
        self._write(self._rest)
