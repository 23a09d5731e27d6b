"""An I2C bus of this computer: ``/dev/i2c-N`` through smbus2, one ``ioctl(I2C_RDWR)`` per transaction.

The buffer of a read is filled with 0xFF first, the value of a released bus. A transfer that ends early without an
error is then visible and does not return bytes of the previous block. Equal messages are built once and reused.

The first program that uses an address holds an advisory lock on it until it closes the bus, as with serial ports. Two
programs that read blocks of one converter would delay each other, and each would measure a slow converter. Programs
without this lock, such as i2cdetect, are not stopped.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import grp
import os
import struct
import threading
import time
from collections.abc import Generator
from fcntl import ioctl
from pathlib import Path
from typing import Final, cast

from smbus2 import I2cFunc, SMBus, i2c_msg

from hal.bus.address_lock import taken
from hal.bus.i2c import Message, Transferred, check
from hal.errors import KEPT_AWAY, DeviceMissing, DeviceRefused, HalError

I2C_TIMEOUT: Final = 0x0702
I2C_SLAVE: Final = 0x0703
TIMEOUT_10MS: Final = 100
"""I2C_TIMEOUT, in units of 10 ms: 8192 bytes at 100 kHz take 0.74 s."""
SYSFS: Final = Path("/sys/class/i2c-dev")
DEV: Final = Path("/dev")
_ADAPTER: Final = "adapter:"
_GONE: Final = frozenset({errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ESHUTDOWN})
ENABLE: Final = "enable I2C (Raspberry Pi: dtparam=i2c_arm=on) and load the module i2c-dev"
"""Remedy where the computer has no bus."""


class LinuxBus:
    """An open device node; see :class:`hal.bus.i2c.Bus`. Made by :func:`open_linux`. Not thread-safe.

    Args:
        name: as the user named it. link: open. about: the adapter's own name.
    """

    def __init__(self, name: str, link: SMBus, about: str) -> None:
        self._name, self._link, self._about = name, link, about
        self._built_for: tuple[Message, ...] = ()
        self._built: list[i2c_msg] = []
        self._reads: list[i2c_msg] = []
        self._claimed: set[int] = set()
        self._closing = threading.Lock()

    @property
    def name(self) -> str:
        """The bus as the user named it."""
        return self._name

    @property
    def about(self) -> str:
        """The adapter's own name."""
        return self._about

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction; raises `OSError`, EBUSY also where a driver or another program has the address."""
        if self._link.fd is None:
            raise OSError(errno.ENODEV, "the bus is closed")
        if messages != self._built_for:
            self._build(messages)
        for message in self._reads:
            _fill(message)
        t0 = time.monotonic()
        self._link.i2c_rdwr(*self._built)
        t1 = time.monotonic()
        return Transferred(t0, t1, tuple(_bytes(message) for message in self._reads))

    def repeat(self, messages: tuple[Message, ...]) -> Generator[Transferred]:
        """Repeat the transaction."""
        while True:
            yield self.transfer(messages)

    def release(self) -> None:
        """Release the address locks: a transaction that hangs keeps the file, and its locks, open."""
        with self._closing:
            if self._link.fd is not None:
                self._claimed.clear()
                self._built_for = ()
                _lock(self._link.fd, fcntl.F_UNLCK, 0, 0)

    def close(self) -> None:
        """Close the device node."""
        with self._closing:
            self._link.close()

    def _build(self, messages: tuple[Message, ...]) -> None:
        check(messages)
        for address in {message.address for message in messages} - self._claimed:
            ioctl(self._link.fd or 0, I2C_SLAVE, address)  # I2C_RDWR itself does not check for a kernel driver
            _claim(self._link.fd or 0, address)
            self._claimed.add(address)
        self._built = [
            i2c_msg.write(message.address, message.data)
            if message.data
            else i2c_msg.read(message.address, message.length)
            for message in messages
        ]
        self._reads = [built for built, message in zip(self._built, messages, strict=True) if message.length]
        self._built_for = messages


def _claim(fd: int, address: int) -> None:
    """Lock the byte of the device node at the address's offset; the lock belongs to the open file and ends with it."""
    try:
        _lock(fd, fcntl.F_WRLCK, address, 1)
    except BlockingIOError:
        raise taken(address) from None


def _lock(fd: int, kind: int, start: int, length: int) -> None:
    """Set or free an open file's lock on some of its bytes; a ``length`` of 0: all from ``start`` on."""
    fcntl.fcntl(fd, fcntl.F_OFD_SETLK, struct.pack("hhqqi", kind, os.SEEK_SET, start, length, 0))  # fcntl(2): l_pid 0


def _fill(message: i2c_msg) -> None:
    ctypes.memset(message.buf, 0xFF, message.len)


def _bytes(message: i2c_msg) -> bytes:
    return cast(bytes, message.__bytes__())  # list(message) takes a thousand times as long; the stub says str


def buses() -> list[str]:
    """Device nodes of this computer's buses, in order of their numbers."""
    numbers = [path.name.removeprefix("i2c-") for path in DEV.glob("i2c-*")]
    return [str(DEV / f"i2c-{number}") for number in sorted(int(text) for text in numbers if text.isdecimal())]


def open_linux(name: str) -> LinuxBus:
    """Open ``/dev/i2c-N`` (or a link to it), or ``adapter:NAME``.

    Raises:
        DeviceMissing: no such bus. DeviceRefused: permission, busy, no I2C bus, or an adapter for SMBus only.
    """
    path = _find(name) if name.startswith(_ADAPTER) else Path(name)
    link = SMBus()
    try:
        link.open(str(path))
        ioctl(link.fd or 0, I2C_TIMEOUT, TIMEOUT_10MS)
    except OSError as error:
        link.close()
        raise explain_open_error(name, path, error) from error
    about = _adapters().get(Path(os.path.realpath(path)).name, "")
    if not link.funcs & I2cFunc.I2C:
        link.close()
        raise DeviceRefused(
            name, f"adapter {about or path} supports only SMBus and cannot read blocks", "use another I2C bus"
        )
    return LinuxBus(name, link, about)


def explain_open_error(name: str, path: Path, error: OSError) -> HalError:
    """Turn the error of a failed open into one of the four kinds of :mod:`hal.errors`, with a remedy."""
    number = error.errno or 0
    if number in _GONE:
        there = buses()
        remedy = f"available buses: {', '.join(there)}" if there else ENABLE
        return DeviceMissing(name, "no such bus" if number == errno.ENOENT else os.strerror(number), remedy)
    if number == errno.EPERM:
        return DeviceRefused(name, *KEPT_AWAY)
    if number == errno.EACCES:
        return DeviceRefused(name, "permission denied", f"add the user to group {_group_of(path)} and log in again")
    if number in (errno.EBUSY, errno.EAGAIN):
        return DeviceRefused(name, "in use by another program", f"find that program with: fuser -v {path}")
    if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR, errno.ENOTDIR):
        return DeviceRefused(name, "not an I2C bus", "name a device node such as /dev/i2c-1")
    return DeviceRefused(name, f"cannot be opened: {os.strerror(number)}", "read the kernel log: dmesg | tail")


def _group_of(path: Path) -> str:
    try:
        group = grp.getgrgid(path.stat().st_gid).gr_name
    except (OSError, KeyError):
        return "i2c"
    return "i2c" if group == "root" else group


def _adapters() -> dict[str, str]:
    """Names of this computer's adapters, by node (``i2c-1``)."""
    found: dict[str, str] = {}
    for folder in sorted(SYSFS.glob("i2c-*")):
        try:
            found[folder.name] = (folder / "name").read_text(encoding="utf-8", errors="replace").strip()
        except OSError:  # unplugged meanwhile
            continue
    return found


def _find(name: str) -> Path:
    wanted = name.removeprefix(_ADAPTER)
    adapters = _adapters()
    matching = [node for node, own in adapters.items() if wanted and wanted in own]
    if len(matching) == 1:
        return DEV / matching[0]
    listed = "; ".join(f"{node}: {own}" for node, own in adapters.items())
    if matching:
        raise DeviceRefused(name, f"{len(matching)} adapters have that name", f"use a path, or a longer name: {listed}")
    raise DeviceMissing(name, "no adapter has that name", f"available adapters: {listed}" if listed else ENABLE)
