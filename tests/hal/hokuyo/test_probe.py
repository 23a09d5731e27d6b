"""Probing: every port says who is there or why not, and sensors are left as they should be."""

import asyncio
from pathlib import Path

import pytest

from hal.clock import LoopClock
from hal.errors import DeviceFault, DeviceMissing
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import URG_04LX, UTM_30LX, Unit
from hal.fake.transport.memory_host import FakeOpener
from hal.hokuyo import discover
from hal.hokuyo.probe import Finding, identify_at, probe
from hal.port.port import Port, memory_pair
from tests.hal.hokuyo.bench import Scene


@pytest.mark.virtual
async def test_who_is_where() -> None:
    plugs = FakeOpener(LoopClock(asyncio.get_running_loop()))
    utm = FakeHokuyo(UTM_30LX, Scene(UTM_30LX), unit=Unit(serial="H1"))
    urg = FakeHokuyo(URG_04LX, Scene(URG_04LX), unit=Unit(serial="H2", baud=115200))
    mute = FakeHokuyo(UTM_30LX, Scene(UTM_30LX))
    plugs.plug("/dev/ttyACM0", utm)
    plugs.plug("/dev/ttyUSB0", urg)
    plugs.plug("/dev/ttyACM1", mute)
    mute.receive = lambda data: None  # type: ignore[method-assign]  # something else than a lidar
    port = await plugs("/dev/ttyACM0", 0)
    port.write(b"MD0000108001000\n")
    await asyncio.sleep(0.5)
    port.close()
    await asyncio.sleep(0.1)
    assert utm.state is State.MULTI
    found = await probe(plugs, ["/dev/ttyACM0", "/dev/ttyUSB0", "/dev/ttyACM1", "/dev/ttyACM9"])
    assert utm.state is State.IDLE
    again = await plugs("/dev/ttyACM0", 0)  # it was closed
    again.close()
    a, b, c, d = found
    assert a.geometry is not None
    assert (a.geometry.serial, a.geometry.amax, a.baud) == ("H1", 1080, 0)
    assert "UTM-30LX" in str(a)
    assert "1081 beams from -135.0 to +135.0 deg, 40.0 Hz" in str(a)
    assert b.geometry is not None
    assert (b.geometry.serial, b.baud) == ("H2", 115200)
    assert isinstance(c.error, DeviceFault)
    assert "no reply" in str(c)
    assert str(Finding("/dev/x")) == "/dev/x: no data"
    assert isinstance(d.error, DeviceMissing)


@pytest.mark.virtual
async def test_a_server_of_something_else_that_hangs_up_is_shown_by_its_first_words() -> None:
    clock = LoopClock(asyncio.get_running_loop())

    async def serves(device: str, baud: int) -> Port:
        ours, its = memory_pair(clock, device)
        its.start(lambda data, _t: its.close(), lambda error: None)
        if "ssh" in device:
            its.write(b"SSH-2.0-OpenSSH_9.2p1 Debian\r\n")
        return ours

    banner, mute = (await identify_at(serves, "tcp://ssh:22"), await identify_at(serves, "tcp://mute:22"))
    assert "only unreadable bytes arrive" in str(banner)
    assert "'SSH-2.0-OpenSSH_9.2p': name the address and port of the lidar" in str(banner)
    assert isinstance(mute.error, DeviceMissing)


def test_candidates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dev, sys_tty = tmp_path / "dev", tmp_path / "sys"
    (dev / "lumiloop").mkdir(parents=True)
    (dev / "serial" / "by-path").mkdir(parents=True)
    for name in ("ttyACM0", "ttyACM1", "ttyACM2", "ttyUSB0"):
        (dev / name).touch()
    for name, vendor in (("ttyACM0", "2341"), ("ttyACM1", "15d1")):
        (sys_tty / name / "device").mkdir(parents=True)
        (sys_tty / name / "device" / "idVendor").write_text(vendor + "\n")
    (dev / "serial" / "by-path" / "usb-1").symlink_to(dev / "ttyACM1")
    monkeypatch.setattr(discover, "_DEV", dev)
    monkeypatch.setattr(discover, "_SYS_TTY", sys_tty)
    # ours first, once, by its stable name; an Arduino is left alone; unknown ones last
    assert discover.candidates() == [
        str(dev / "serial" / "by-path" / "usb-1"),
        str(dev / "ttyACM2"),
        str(dev / "ttyUSB0"),
    ]
    (dev / "lumiloop" / "lidar").symlink_to(dev / "ttyACM1")
    assert discover.candidates()[0] == str(dev / "lumiloop" / "lidar")


def test_usb_vendor_is_found_above_the_interface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As sysfs has it: the tty's device is the interface, the vendor stands at the USB device above it."""
    interface = tmp_path / "devices" / "usb1" / "1-1" / "1-1:1.0"
    interface.mkdir(parents=True)
    (interface.parent / "idVendor").write_text("15D1\n")
    (tmp_path / "ttyACM0").mkdir()
    (tmp_path / "ttyACM0" / "device").symlink_to(interface)
    (tmp_path / "ttyS0" / "device" / "a" / "b").mkdir(parents=True)
    monkeypatch.setattr(discover, "_SYS_TTY", tmp_path)
    assert discover.usb_vendor("ttyACM0") == "15d1"
    assert discover.usb_vendor("ttyS0") == ""
    assert discover.usb_vendor("ttyACM1") == ""


def test_nothing_plugged_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discover, "_DEV", tmp_path)
    assert discover.candidates() == []


@pytest.mark.parametrize(
    ("device", "rs232"),
    [
        ("/dev/ttyUSB0", True),
        ("/dev/ttyS0", True),
        ("/dev/ttyAMA0", True),
        ("/dev/ttyACM0", False),
        ("/dev/pts/3", False),
        ("tcp://ttyS0", False),
    ],
)
def test_line_kinds(device: str, rs232: bool) -> None:
    assert discover.is_rs232(device) is rs232


@pytest.mark.parametrize(
    ("device", "rs232"),
    [("/dev/pts/3", True), ("/tmp/lidar", True), ("/dev/ttyUSB0", True), ("/dev/ttyACM0", False), ("tcp://h", False)],
)
def test_a_rate_that_somebody_has_written_makes_a_line_of_what_is_not_known(device: str, rs232: bool) -> None:
    assert discover.is_rs232(device, 19200) is rs232


@pytest.mark.parametrize("wrong", [0, 19200])
@pytest.mark.virtual
async def test_a_line_that_nothing_tells_to_be_one_is_found_with_its_rate(wrong: int) -> None:
    """Also where the sensor talks at another rate than the one that was written."""
    plugs = FakeOpener(LoopClock(asyncio.get_running_loop()))
    plugs.plug("/dev/pts/7", FakeHokuyo(URG_04LX, Scene(URG_04LX), unit=Unit(serial="H2", baud=57600)))
    unknown = await identify_at(plugs, "/dev/pts/7")
    await asyncio.sleep(0.1)  # it is closed
    unknown, found = (unknown, await identify_at(plugs, "/dev/pts/7", wrong or 57600))
    assert unknown.geometry is None
    assert found.geometry is not None
    assert found.baud == 57600


def test_line_kind_behind_a_link(tmp_path: Path) -> None:
    (tmp_path / "ttyUSB3").touch()
    (tmp_path / "lidar").symlink_to(tmp_path / "ttyUSB3")
    assert discover.is_rs232(str(tmp_path / "lidar"))
