"""``/dev/i2c-N`` through smbus2, with the kernel's ioctl replaced by a model of it."""

import asyncio
import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

import hal.bus.i2c_linux
from hal.bus.i2c import NACKS, read, write
from hal.bus.i2c_linux import open_linux
from hal.bus.opening import open_bus
from hal.errors import DeviceMissing, DeviceRefused
from tests.hal.bus.i2c_kernel import I2C_FUNC_SMBUS, kernel


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A computer with three adapters."""
    names = {
        "i2c-0": "Synopsys DesignWare I2C adapter",
        "i2c-1": "bcm2835 (i2c@7e804000)",
        "i2c-3": "CP2112 SMBus Bridge",
    }
    (tmp_path / "dev").mkdir()
    for node, name in names.items():
        (tmp_path / "sys" / node).mkdir(parents=True)
        (tmp_path / "sys" / node / "name").write_text(name + "\n")
        (tmp_path / "dev" / node).touch()
    monkeypatch.setattr(hal.bus.i2c_linux, "SYSFS", tmp_path / "sys")
    monkeypatch.setattr(hal.bus.i2c_linux, "DEV", tmp_path / "dev")
    return tmp_path


def test_a_block_is_one_ioctl_with_times_around_it(monkeypatch: pytest.MonkeyPatch) -> None:
    linux = kernel(monkeypatch)
    bus = open_linux("/dev/i2c-1")
    done = bus.transfer((read(0x4D, 800),))
    assert linux.device.bus.transactions == 1
    assert len(done.reads) == 1
    assert len(done.reads[0]) == 800
    assert 7210 / 400e3 < done.t1 - done.t0 < 4 * 7210 / 400e3
    assert linux.settings[0x0702] == 100  # 1 s in units of 10 ms
    bus.close()
    bus.close()
    assert linux.closed == 1
    assert linux.paths == ["/dev/i2c-1"]


def test_write_and_read_are_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    linux = kernel(monkeypatch)
    linux.device.add_level(lambda t: t)
    bus = open_linux("/dev/i2c-1")
    done = bus.transfer((write(0x48, b"\x03"), read(0x48, 2)))
    assert done.reads == (b"\x7f\xff",)
    assert linux.device.bus.transactions == 1


def test_the_same_messages_are_built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    linux = kernel(monkeypatch)
    bus = open_linux("/dev/i2c-1")
    stream = bus.repeat((read(0x4D, 60),))
    blocks = [next(stream).reads[0] for _ in range(3)]
    built = list(bus._built)
    next(stream)
    assert all(a is b for a, b in zip(built, bus._built, strict=True))
    assert len(set(blocks)) == 3
    stream.close()
    assert linux.device.bus.transactions == 4


@pytest.mark.parametrize("name", ["EIO", "ENXIO", "EREMOTEIO", "ETIMEDOUT", "EAGAIN", "ENODEV", "EOPNOTSUPP", "EPROTO"])
def test_errors_come_through_with_their_errno(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    linux = kernel(monkeypatch)
    bus = open_linux("/dev/i2c-1")
    linux.fails = [getattr(errno, name)]
    with pytest.raises(OSError, match=os.strerror(getattr(errno, name))) as caught:
        bus.transfer((read(0x4D, 60),))
    assert caught.value.errno == getattr(errno, name)
    assert len(bus.transfer((read(0x4D, 60),)).reads[0]) == 60


def test_what_was_not_read_does_not_look_like_the_block_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """smbus2 drops ioctl's count of messages, and a buffer that is used again keeps what was in it."""
    linux = kernel(monkeypatch)
    bus = open_linux("/dev/i2c-1")
    bus.transfer((read(0x4D, 60),))
    linux.short = 20
    data = bus.transfer((read(0x4D, 60),)).reads[0]
    assert data[40:] == b"\xff" * 20
    assert data[:40] != b"\xff" * 40


@pytest.mark.parametrize("length", [8193, 65538])
def test_lengths_that_smbus2_would_cut_are_refused(monkeypatch: pytest.MonkeyPatch, length: int) -> None:
    kernel(monkeypatch)
    with pytest.raises(OSError, match=f"{length} bytes") as caught:
        open_linux("/dev/i2c-1").transfer((read(0x4D, length),))
    assert caught.value.errno == errno.EINVAL


def test_an_address_with_a_kernel_driver_is_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    linux = kernel(monkeypatch)
    linux.claimed = {0x4D}
    with pytest.raises(OSError, match="busy") as caught:
        open_linux("/dev/i2c-1").transfer((read(0x4D, 2),))
    assert caught.value.errno == errno.EBUSY


def test_an_address_belongs_to_who_spoke_to_it_first(monkeypatch: pytest.MonkeyPatch) -> None:
    linux = kernel(monkeypatch)
    first, second = open_linux("/dev/i2c-1"), open_linux("/dev/i2c-1")
    for _ in range(2):  # its own lock is in nobody's way
        first.transfer((read(0x4D, 2),))
    with pytest.raises(OSError, match="another lumiloop or its bus server uses address 0x4d") as caught:
        second.transfer((read(0x4D, 2),))
    assert caught.value.errno == errno.EBUSY
    with pytest.raises(OSError) as caught:  # noqa: PT011 - nobody answers there: another address is not locked
        second.transfer((read(0x4E, 2),))
    assert caught.value.errno in NACKS
    first.close()
    second.transfer((read(0x4D, 2),))
    assert linux.closed == 1


async def test_a_bus_that_was_closed_while_a_transaction_hangs_has_no_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its driver opens it anew meanwhile: what hangs is to be named as that, not as another program."""
    linux = kernel(monkeypatch)
    bus = await open_bus("/dev/i2c-1")
    await bus.transfer((read(0x4D, 2),))
    linux.hang = True
    hanging = asyncio.create_task(bus.transfer((read(0x4D, 2),)))
    await asyncio.sleep(0.05)
    await bus.close()
    again = await open_bus("/dev/i2c-1")
    waiting = asyncio.create_task(again.transfer((read(0x4D, 2),)))
    done, _ = await asyncio.wait({waiting}, timeout=0.1)
    assert not done, await waiting
    linux.hang = False
    await asyncio.gather(hanging, waiting)
    await again.transfer((read(0x4D, 2),))  # the end of the first one has not taken its address away
    with pytest.raises(OSError, match="another lumiloop"):
        open_linux("/dev/i2c-1").transfer((read(0x4D, 2),))
    await again.close()


def test_a_closed_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel(monkeypatch)
    bus = open_linux("/dev/i2c-1")
    bus.close()
    with pytest.raises(OSError, match="closed"):
        bus.transfer((read(0x4D, 2),))


@pytest.mark.parametrize(
    ("number", "kind", "says"),
    [
        (errno.ENOENT, DeviceMissing, r"no such bus .available buses: .*i2c-0, .*i2c-1"),
        (errno.ENXIO, DeviceMissing, "No such device or address"),
        (errno.ENODEV, DeviceMissing, "No such device"),
        (errno.EACCES, DeviceRefused, r"permission denied .add the user to group i2c and log in again"),
        (errno.EPERM, DeviceRefused, r"not permitted .*DeviceAllow="),
        (errno.EBUSY, DeviceRefused, r"in use by another program .find that program with: fuser -v /dev/i2c-1"),
        (errno.EISDIR, DeviceRefused, r"not an I2C bus .*such as /dev/i2c-1"),
        (errno.EMFILE, DeviceRefused, r"cannot be opened: Too many open files .*dmesg"),
    ],
)
def test_what_an_open_says(
    monkeypatch: pytest.MonkeyPatch, host: Path, number: int, kind: type[Exception], says: str
) -> None:
    kernel(monkeypatch).open_error = number
    with pytest.raises(kind, match=f"^/dev/i2c-1: .*{says}"):
        open_linux("/dev/i2c-1")


def test_without_any_bus_the_remedy_is_to_enable_i2c(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(hal.bus.i2c_linux, "DEV", tmp_path)
    with pytest.raises(DeviceMissing, match=r"dtparam=i2c_arm=on.*i2c-dev"):
        open_linux("/dev/i2c-99")


def test_the_group_is_that_of_the_device_node(monkeypatch: pytest.MonkeyPatch, host: Path) -> None:
    kernel(monkeypatch).open_error = errno.EACCES
    groups = SimpleNamespace(getgrgid=lambda gid: SimpleNamespace(gr_name=f"group-{gid}"))
    monkeypatch.setattr(hal.bus.i2c_linux, "grp", groups)
    node = host / "dev" / "i2c-1"
    with pytest.raises(DeviceRefused, match=f"add the user to group group-{node.stat().st_gid}"):
        open_linux(str(node))


def test_something_that_is_no_bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    thing = tmp_path / "file"
    thing.touch()
    with pytest.raises(DeviceRefused, match="not an I2C bus"):
        open_linux(str(thing))
    with pytest.raises(DeviceRefused, match="not an I2C bus"):
        open_linux("/dev/null")


def test_an_adapter_for_smbus_only(monkeypatch: pytest.MonkeyPatch, host: Path) -> None:
    linux = kernel(monkeypatch)
    linux.funcs = I2C_FUNC_SMBUS
    with pytest.raises(DeviceRefused, match=r"adapter Synopsys.* supports only SMBus and cannot read blocks"):
        open_linux("/dev/i2c-0")
    assert linux.closed == 1


@pytest.mark.parametrize(("name", "node"), [("adapter:CP2112", "i2c-3"), ("adapter:bcm2835 (i2c@7e804000)", "i2c-1")])
def test_by_the_adapters_own_name(monkeypatch: pytest.MonkeyPatch, host: Path, name: str, node: str) -> None:
    linux = kernel(monkeypatch)
    bus = open_linux(name)
    assert linux.paths == [str(host / "dev" / node)]
    assert bus.name == name
    assert bus.about == (host / "sys" / node / "name").read_text().strip()


def test_bus_numbers_may_change(monkeypatch: pytest.MonkeyPatch, host: Path) -> None:
    linux = kernel(monkeypatch)
    open_linux("adapter:CP2112").close()
    (host / "sys" / "i2c-3").rename(host / "sys" / "i2c-7")
    open_linux("adapter:CP2112")
    assert linux.paths[-1] == str(host / "dev" / "i2c-7")


@pytest.mark.parametrize(
    ("name", "kind", "says"),
    [
        ("adapter:FT260", DeviceMissing, r"no adapter has that name .available adapters: i2c-0: Synopsys"),
        ("adapter:", DeviceMissing, "no adapter has that name"),
        ("adapter:B", DeviceRefused, None),
    ],
)
def test_names_that_do_not_choose_one(host: Path, name: str, kind: type[Exception], says: str | None) -> None:
    if says is None:
        (host / "sys" / "i2c-4").mkdir()
        (host / "sys" / "i2c-4" / "name").write_text("CP2112 SMBus Bridge\n")
        name, says = "adapter:CP2112", "2 adapters have that name .*i2c-3: CP2112"
    with pytest.raises(kind, match=says):
        open_linux(name)


def test_without_adapters_the_name_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(hal.bus.i2c_linux, "SYSFS", tmp_path / "none")
    with pytest.raises(DeviceMissing, match="enable I2C"):
        open_linux("adapter:bcm2835")
