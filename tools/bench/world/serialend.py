"""The fake lidar out of a serial port that is there: a USB-serial adapter, or this computer's own CDC gadget."""

import asyncio
import os
import re
import termios
from pathlib import Path

import serial

from hal.errors import DeviceMissing, HalError
from hal.fake.lidar.device import FakeHokuyo
from hal.port.serial_port import explain_open_error

QUEUE = 64 * 1024
"""Bytes that may wait for the line before whole replies are lost, as in a sensor."""
REMEDIES = {
    r"ttyGS\d+": "needs a USB device port and its gadget: modprobe g_serial (a PC's ports are hosts only)",
    r"ttyUSB\d+": "plug the USB-serial adapter in; its module is ftdi_sio, cp210x, ch341 or pl2303 (dmesg | tail)",
    r"ttyACM\d+": "plug it in; its module is cdc_acm (modprobe cdc_acm, dmesg | tail)",
}


class SerialEnd:
    """A port of this computer at whose other end the robot computer takes us for a lidar.

    Args:
        device: the sensor. path: of the port. baud: line rate in bit/s; a CDC gadget does not care.

    Raises:
        DeviceMissing, DeviceRefused: as for any serial port, with the remedy.
    """

    def __init__(self, device: FakeHokuyo, path: str, baud: int = 115200) -> None:
        self._device, self._baud, self.path = device, baud, path
        self._loop = asyncio.get_running_loop()
        try:
            self._line = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True, inter_byte_timeout=0)
        except (OSError, ValueError, termios.error) as error:
            raise _explained(path, baud, error) from error
        self._fd = self._line.fileno()
        os.set_blocking(self._fd, False)
        self._waiting = bytearray()
        self.lost: HalError | None = None
        self._loop.add_reader(self._fd, self._read)
        device.attach(self)

    def accept(self, data: bytes) -> bool:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        if self.lost is not None or len(self._waiting) + len(data) > QUEUE:
            return False
        self._waiting += data
        self._flush()
        return True

    def baud(self) -> int:
        """See :class:`hal.fake.lidar.output_line.HostEnd`: both ends are set to the same rate."""
        return self._baud

    def hang_up(self) -> None:
        """See :class:`hal.fake.lidar.output_line.HostEnd`: a serial line cannot hang up; it only falls silent."""
        self._waiting.clear()

    def close(self) -> None:
        """Give the port back."""
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._device.detach()
        self._line.close()

    def _flush(self) -> None:
        try:
            sent = os.write(self._fd, self._waiting)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self._gone(error)
            return
        del self._waiting[:sent]
        if self._waiting:
            self._loop.add_writer(self._fd, self._flush)
        else:
            self._loop.remove_writer(self._fd)

    def _read(self) -> None:
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return
        except OSError as error:
            self._gone(error)
            return
        if data:
            self._device.receive(data)
        else:
            self._gone(None)

    def _gone(self, error: OSError | None) -> None:
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        problem = "unplugged" if error is None else os.strerror(error.errno or 0)
        self.lost = DeviceMissing(self.path, problem, "plug the bench's own line in again and start anew")


def _explained(path: str, baud: int, error: BaseException) -> HalError:
    """What the system says of an open; where the node is missing, which kernel module makes it."""
    told = explain_open_error(path, baud, error)
    for pattern, remedy in REMEDIES.items():
        if isinstance(told, DeviceMissing) and not Path(path).exists() and re.search(pattern, path):
            return DeviceMissing(path, told.problem, remedy)
    return told
