"""The serial port on a kernel pty: delivery, hang-up, exclusiveness, and every open error with its remedy."""

import asyncio
import errno
import os
import stat
import termios
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.port import serial_port
from hal.port.opening import open_port
from hal.port.serial_port import SerialPort, explain_open_error


class Pty:
    """A master end and the path of its slave."""

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self._slave)

    def close(self) -> None:
        for fd in (self.master, self._slave):
            if fd >= 0:
                os.close(fd)
        self.master = self._slave = -1


@pytest.fixture
def pty() -> Iterator[Pty]:
    pair = Pty()
    yield pair
    pair.close()


async def until(condition: object, seconds: float = 4.0) -> None:
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        await asyncio.sleep(0.002)


async def test_bytes_both_ways_and_hang_up(pty: Pty) -> None:
    port = await open_port(pty.path, 115200)
    got: list[tuple[bytes, float]] = []
    lost: list[HalError] = []
    os.write(pty.master, b"before start ")
    port.start(lambda data, t_rx: got.append((data, t_rx)), lost.append)
    os.write(pty.master, b"\x00\xff\n\r\x11\x13\x03")  # a raw line alters none of these
    await until(lambda: b"".join(d for d, _ in got) == b"before start \x00\xff\n\r\x11\x13\x03")
    port.write(b"VV\n")
    await asyncio.sleep(0.01)
    assert os.read(pty.master, 100) == b"VV\n"
    assert all(abs(t - time.monotonic()) < 4.0 for _, t in got)
    port.set_baud(750000)
    pty.close()  # unplug
    await until(lambda: lost)
    await asyncio.sleep(0.05)
    assert [type(error) for error in lost] == [DeviceMissing]
    assert isinstance(port, SerialPort)
    assert not asyncio.get_running_loop().remove_reader(port._fd)  # a line that hung up is readable for ever
    assert lost[0].device == port.name
    assert lost[0].remedy
    with pytest.raises(DeviceMissing):
        port.write(b"QT\n")
    port.close()
    port.close()
    with pytest.raises(DeviceMissing):
        port.write(b"QT\n")


async def test_spurious_wake_up_is_no_unplug(pty: Pty) -> None:
    port = await open_port(pty.path, 115200)
    lost: list[HalError] = []
    port.start(lambda data, t_rx: None, lost.append)
    assert isinstance(port, SerialPort)
    port._readable()
    assert lost == []
    port.close()


async def test_a_line_that_takes_nothing_is_a_fault_not_a_stall(pty: Pty) -> None:
    port = await open_port(pty.path, 115200)
    with pytest.raises(DeviceFault, match="command bytes"):
        port.write(b"x" * 409600)
    began = time.monotonic()
    port.close()
    assert time.monotonic() - began < 4.0


async def test_second_open_is_refused_as_busy(pty: Pty) -> None:
    port = await open_port(pty.path, 115200)
    with pytest.raises(DeviceRefused, match=r"in use by another program.*fuser"):
        await open_port(pty.path, 115200)
    port.close()
    again = await open_port(pty.path, 115200)
    again.close()


async def test_open_errors_name_thing_and_remedy(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("hello")
    with pytest.raises(DeviceMissing, match=r"/dev/no-such-lidar: no such device .*probe"):
        await open_port("/dev/no-such-lidar", 115200)
    for path in (str(file), str(tmp_path), "/dev/null"):
        with pytest.raises(DeviceRefused, match="not a serial port"):
            await open_port(path, 115200)


@pytest.mark.parametrize(
    ("name", "loaded", "says"),
    [
        ("ttyACM7", "", "; its kernel module is not loaded: modprobe cdc_acm)"),
        ("ttyACM7", "cdc_acm", "find it with: lumiloop probe)"),
        ("ttyUSB7", "cdc_acm", "; its kernel module is not loaded: modprobe ftdi_sio or cp210x or ch341 or pl2303)"),
        ("ttyUSB7", "ch341", "find it with: lumiloop probe)"),
        ("lidar", "", "find it with: lumiloop probe)"),
    ],
)
def test_a_device_file_that_no_loaded_module_makes_is_said_to_lack_it(
    name: str, loaded: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_port, "_DRIVERS", tmp_path)
    if loaded:
        (tmp_path / loaded).mkdir()
    missing = explain_open_error(str(tmp_path / name), 115200, FileNotFoundError(errno.ENOENT, "No such file"))
    assert str(missing).endswith(says)


async def test_impossible_rate_is_refused(pty: Pty) -> None:
    with pytest.raises(DeviceRefused, match="does not support -5 bit/s"):
        await open_port(pty.path, -5)
    port = await open_port(pty.path, 19200)
    with pytest.raises(DeviceRefused, match="does not support -5 bit/s"):
        port.set_baud(-5)
    port.close()


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.EACCES, DeviceRefused, "group dialout"),
        (errno.EPERM, DeviceRefused, "not permitted (the service unit denies this device"),
        (errno.EBUSY, DeviceRefused, "in use by another program"),
        (errno.EAGAIN, DeviceRefused, "in use by another program"),
        (errno.ENODEV, DeviceMissing, "connect the sensor"),
        (errno.EIO, DeviceMissing, "connect the sensor"),
        (errno.ENOTTY, DeviceRefused, "not a serial port"),
        (errno.EMFILE, DeviceRefused, "dmesg"),
    ],
)
def test_errno_to_noun(number: int, kind: type[HalError], words: str) -> None:
    error = explain_open_error("/dev/null", 19200, serial.SerialException(number, "could not open port"))
    assert type(error) is kind
    assert words in str(error)
    assert "/dev/null" in str(error)


def test_errno_inside_a_wrapped_termios_error() -> None:
    wrapped = serial.SerialException("Could not configure port: (25, 'Inappropriate ioctl for device')")
    wrapped.__context__ = termios.error(errno.ENOTTY, "Inappropriate ioctl for device")
    assert "not a serial port" in str(explain_open_error("/dev/null", 19200, wrapped))


def test_a_line_that_does_not_take_a_character_format_is_named_with_it() -> None:
    wrapped = serial.SerialException("Could not configure port: (22, 'Invalid argument')")
    wrapped.__context__ = termios.error(errno.EINVAL, "Invalid argument")
    error = explain_open_error("/dev/null", 19200, wrapped, "8E1")
    assert "does not support the character format 8E1" in str(error)
    assert "8N1" in error.remedy
    assert "not a serial port" in str(explain_open_error("/dev/null", 19200, wrapped, "8N1"))


def test_permission_remedy_names_the_group_of_the_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Entry:
        gr_name = "uucp"

    monkeypatch.setattr("hal.port.serial_port.grp.getgrgid", lambda gid: Entry())
    error = explain_open_error("/dev/null", 19200, PermissionError(errno.EACCES, "no"))
    assert "group uucp" in error.remedy
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


async def test_cancelled_open_leaves_nothing_open(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[serial.Serial] = []
    real = serial.Serial

    def slow(*args: object, **kwargs: object) -> serial.Serial:
        time.sleep(0.1)
        opened.append(real(*args, **kwargs))  # type: ignore[arg-type]  # passes through what it was given
        return opened[-1]

    monkeypatch.setattr("hal.port.serial_port.serial.Serial", slow)
    task = asyncio.create_task(open_port(pty.path, 115200))
    await asyncio.sleep(0.02)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await until(lambda: opened)
    await until(lambda: not opened[0].is_open)
