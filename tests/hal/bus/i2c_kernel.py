"""A model of the kernel's i2c-dev behind smbus2: ``open`` and ``ioctl`` replaced, a simulated bus instead of a wire."""

import ctypes
import errno
import os
import time
from types import SimpleNamespace
from typing import Any

import pytest

import hal.bus.i2c_linux
from hal.bus.i2c import Message, Transferred
from hal.clock import SystemClock
from hal.fake.adc.converter import FakeAdc

I2C_FUNC_I2C = 1
I2C_FUNC_SMBUS = 0x00020000


class Kernel:
    """What a process sees of one adapter.

    Args:
        monkeypatch: puts it in the place of the kernel. device: the simulated bus.

    Attributes:
        open_error: errno of the next open. funcs: what the adapter can do. claimed: addresses with a kernel driver.
        settings: what was set by ioctl. short: bytes that the next reads leave out, without an error.
        hang: transactions do not return until it is cleared.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, device: FakeAdc) -> None:
        self.device = device
        self.open_error = 0
        self.funcs = I2C_FUNC_I2C
        self.claimed: set[int] = set()
        self.settings: dict[int, int] = {}
        self.short = 0
        self.hang = False
        self.paths: list[str] = []
        self.closed = 0
        self.fails: list[int] = []
        self._node = os.memfd_create("i2c")  # each open is a file of its own, for locks
        self._open: set[int] = set()
        fake_os = SimpleNamespace(open=self.open, close=self.close, O_RDWR=os.O_RDWR)
        monkeypatch.setattr("smbus2.smbus2.os", fake_os)
        monkeypatch.setattr("smbus2.smbus2.ioctl", self.ioctl)
        monkeypatch.setattr(hal.bus.i2c_linux, "ioctl", self.ioctl)

    def open(self, path: str, _flags: int) -> int:
        self.paths.append(path)
        if self.open_error:
            raise OSError(self.open_error, os.strerror(self.open_error), path)
        fd = os.open(f"/proc/self/fd/{self._node}", os.O_RDWR)
        self._open.add(fd)
        return fd

    def close(self, fd: int) -> None:
        self._open.remove(fd)
        os.close(fd)
        self.closed += 1

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        assert fd in self._open
        if request == 0x0705:
            argument.value = self.funcs
        elif request == 0x0707:
            self._transfer([argument.msgs[k] for k in range(argument.nmsgs)])
        elif request == 0x0703 and argument in self.claimed:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        else:
            self.settings[request] = argument
        return 0

    def __del__(self) -> None:
        os.close(self._node)

    def _transfer(self, raw: list[Any]) -> None:
        while self.hang:
            time.sleep(0.005)
        if self.fails and (code := self.fails.pop(0)):
            raise OSError(code, os.strerror(code))
        messages = tuple(
            Message(m.addr, length=m.len) if m.flags & 1 else Message(m.addr, bytes(m.buf[: m.len])) for m in raw
        )
        pending = self.device.bus.begin(messages)
        time.sleep(max(0.0, pending.t_end - time.monotonic()))
        reads = iter(pending.finish().reads)
        for message in raw:
            if message.flags & 1:
                data = next(reads)
                ctypes.memmove(message.buf, data, len(data) - self.short)


def kernel(monkeypatch: pytest.MonkeyPatch, device: FakeAdc | None = None) -> Kernel:
    """A kernel with an MCP3221 at 0x4D whose input rises by a step a conversion or so."""
    return Kernel(monkeypatch, device or FakeAdc(lambda t: (t * 5.0) % 1.0, SystemClock()))


def transferred(*reads: bytes, t0: float = 0.0, t1: float = 0.0) -> Transferred:
    return Transferred(t0, t1, reads)
