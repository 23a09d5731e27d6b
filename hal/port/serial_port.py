"""A serial port read by the event loop, without a reader thread.

The line is opened so that an empty read always means hang-up: ``inter_byte_timeout=0`` makes pyserial set VMIN=1,
VTIME=0, where a spurious wake-up gives EAGAIN. With VMIN=0 it would look like an unplug.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import grp
import os
import stat
import termios
from functools import partial
from pathlib import Path

import serial

from hal.blocking_calls import run_in_thread
from hal.clock import Clock, SystemClock
from hal.errors import KEPT_AWAY, DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.port.port import OnData, OnLost

_READ_SIZE = 65536  # a tty hands out at most 4095 bytes at once
_GONE = frozenset({errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO, errno.ESHUTDOWN, errno.ETIMEDOUT})
NOT_SERIAL = "not a serial port"
_DRIVERS = Path("/sys/bus/usb/drivers")
_MODULES = {"ttyACM": ("cdc_acm",), "ttyUSB": ("ftdi_sio", "cp210x", "ch341", "pl2303")}
"""Kernel modules behind device files of such names; the kernel loads them with the device where they are installed."""
_UNPLUGGED = "connect it again, and check its cable and power; the daemon reopens it automatically"


class SerialPort:
    """An open tty (RS-232, USB CDC-ACM, a pty); see :class:`hal.port.port.Port`."""

    def __init__(self, line: serial.Serial, clock: Clock) -> None:
        self._line = line
        self._name = str(line.port)
        self._fd: int = line.fileno()
        self._clock = clock
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_data: OnData | None = None
        self._on_lost: OnLost | None = None
        self._closed = False

    @property
    def name(self) -> str:
        """Path of the device file."""
        return self._name

    def start(self, on_data: OnData, on_lost: OnLost) -> None:
        """Begin delivering; what the kernel has already buffered comes first."""
        self._on_data, self._on_lost = on_data, on_lost
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._readable)

    def write(self, data: bytes) -> None:
        """Send a command at once.

        Raises:
            DeviceMissing: the port is gone. DeviceFault: the line does not accept the bytes (its buffer is full).
        """
        if self._closed:
            raise DeviceMissing(self._name, "the port is closed")
        try:
            sent = os.write(self._fd, data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise DeviceMissing(self._name, f"write failed: {os.strerror(error.errno or 0)}", _UNPLUGGED) from error
        if sent != len(data):
            raise DeviceFault(
                self._name,
                f"accepted {sent} of {len(data)} command bytes",
                "the line is blocked; disconnect and connect it again",
            )

    def set_baud(self, baud: int) -> None:
        """Change the line rate in bit/s; raises `DeviceRefused` for a rate that the adapter does not support."""
        try:
            self._line.baudrate = baud
        except (ValueError, OSError, termios.error) as error:
            if _errno_of(error) in _GONE:
                raise DeviceMissing(self._name, "the port was removed", _UNPLUGGED) from error
            raise DeviceRefused(self._name, f"does not support {baud} bit/s", "choose another line rate") from error

    def close(self) -> None:
        """Close without waiting for unsent bytes (a plain close of a wedged line blocks for up to 30 s)."""
        if self._closed:
            return
        self._closed = True
        self._unwatch()
        with contextlib.suppress(OSError, termios.error):  # a line that has hung up cannot be flushed
            termios.tcflush(self._fd, termios.TCOFLUSH)
        with contextlib.suppress(OSError):
            self._line.close()

    def _readable(self) -> None:
        t_rx = self._clock.now()
        try:
            data = os.read(self._fd, _READ_SIZE)
        except BlockingIOError:
            return
        except OSError as error:
            self._hung_up(f"read failed: {os.strerror(error.errno or 0)}")
            return
        if not data:
            self._hung_up("unplugged (the line has closed)")
        elif self._on_data is not None:
            self._on_data(data, t_rx)

    def _hung_up(self, problem: str) -> None:
        self._unwatch()  # at once: a line that hung up is readable for ever
        on_lost, self._on_lost = self._on_lost, None
        if on_lost is not None:
            on_lost(DeviceMissing(self._name, problem, _UNPLUGGED))

    def _unwatch(self) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.remove_reader(self._fd)


async def open_serial_port(device: str, baud: int, clock: Clock | None = None, style: str = "8N1") -> SerialPort:
    """Open ``device`` exclusively (advisory lock), raw, without flow control; ``style``: bits, parity, stop bits.

    The kernel may block in ``open`` for seconds when a USB device is wedged: the call runs in a thread.

    Raises:
        DeviceMissing: no such device. DeviceRefused: permission, busy, not a serial port, unsupported rate.
    """
    opening = run_in_thread(partial(_open_line, device, baud, style), "open")
    try:
        line = await asyncio.shield(opening)
    except asyncio.CancelledError:
        opening.add_done_callback(_close_late)
        raise
    except (ValueError, OSError, termios.error) as error:
        raise explain_open_error(device, baud, error, style) from error
    return SerialPort(line, clock or SystemClock())


def _open_line(device: str, baud: int, style: str) -> serial.Serial:
    line = serial.Serial(
        device,
        baud,
        bytesize=int(style[0]),
        parity=style[1],
        stopbits=int(style[2]),
        timeout=0,
        write_timeout=0,
        exclusive=True,
        inter_byte_timeout=0,
    )
    if "ttyUSB" in os.path.realpath(device):  # FTDI: 1 ms instead of 16 ms between transfers
        with contextlib.suppress(ValueError, OSError):
            line.set_low_latency_mode(True)
    return line


def _close_late(opening: asyncio.Future[serial.Serial]) -> None:
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()


def _errno_of(error: BaseException | None) -> int:
    """Errno of a failed open, also where pyserial wrapped a termios error in text; 0 if there is none."""
    while error is not None:
        number = error.args[0] if error.args else None
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return 0


def explain_open_error(device: str, baud: int, error: BaseException, style: str = "8N1") -> HalError:
    """Turn the error of a failed open into one of the four kinds of :mod:`hal.errors`, with a remedy."""
    number = _errno_of(error)
    path = Path(device)
    if number == errno.ENOENT:
        remedy = f"connect the sensor, or find it with: lumiloop probe{_not_loaded(path)}"
        return DeviceMissing(device, "no such device", remedy)
    if number in _GONE:
        return DeviceMissing(device, os.strerror(number), "connect the sensor; the daemon then opens it automatically")
    if number == errno.EPERM:
        return DeviceRefused(device, *KEPT_AWAY)
    if number == errno.EACCES:
        return DeviceRefused(device, "permission denied", f"add the user to group {_group_of(path)} and log in again")
    if number in (errno.EBUSY, errno.EAGAIN):
        return DeviceRefused(device, "in use by another program", f"find that program with: fuser -v {device}")
    if number == errno.EINVAL and style != "8N1" and _is_character_device(path):
        remedy = "name another format after the line rate; a pseudo-terminal supports only 8N1"
        return DeviceRefused(device, f"does not support the character format {style}", remedy)
    if number in (errno.ENOTTY, errno.EISDIR, errno.EINVAL) or not _is_character_device(path):
        return DeviceRefused(device, NOT_SERIAL, "name the device file of the sensor, such as /dev/ttyACM0")
    if isinstance(error, ValueError):
        return DeviceRefused(device, f"does not support {baud} bit/s", "choose another line rate")
    return DeviceRefused(device, f"cannot be opened: {error}", "read the kernel log: dmesg | tail")


def _not_loaded(path: Path) -> str:
    """Remedy that names the missing kernel module; empty where it is loaded, or the device's kind is unknown."""
    for kind, modules in _MODULES.items():
        if path.name.startswith(kind) and not any((_DRIVERS / module).exists() for module in modules):
            return f"; its kernel module is not loaded: modprobe {' or '.join(modules)}"
    return ""


def _group_of(path: Path) -> str:
    try:
        name = grp.getgrgid(path.stat().st_gid).gr_name
    except (OSError, KeyError):
        return "dialout"
    return "dialout" if name == "root" else name


def _is_character_device(path: Path) -> bool:
    try:
        return stat.S_ISCHR(path.stat().st_mode)
    except OSError:
        return False
