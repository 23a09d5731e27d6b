"""The bus server: several clients, malformed requests, addresses, the command."""

import asyncio
import errno
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from hal.bus import i2c_frames as frames
from hal.bus.i2c import read
from hal.bus.i2c_server import BusServer
from hal.bus.opening import open_bus
from hal.clock import SystemClock
from hal.errors import DeviceMissing, DeviceRefused
from hal.fake.adc.converter import FakeBuses
from tests.hal.bus.remote_bus import served


async def test_two_clients_take_turns(tmp_path: Path) -> None:
    async with served("unix", tmp_path) as (where, fake, _schedule):
        fake.add_level(lambda t: t % 1.0)
        one, two = await open_bus(where), await open_bus(where)
        clients = ((one, 0x4D), (two, 0x48), (one, 0x4D), (two, 0x48))
        done = await asyncio.gather(*(bus.transfer((read(address, 400),)) for bus, address in clients))
        spans = sorted((d.t1 - d.t0) for d in done)
        assert spans[-1] > 1.5 * spans[0]  # two of them had to wait for another one's
        await one.close()
        await two.close()


@pytest.mark.parametrize("kind", ["unix", "tcp"])
async def test_a_converter_has_one_lumiloop_at_a_time(kind: str, tmp_path: Path) -> None:
    """Another process is refused as this one is; its error names the process that has the converter."""
    async with served(kind, tmp_path) as (where, _, _schedule):
        one, two = await open_bus(where), await open_bus(where)
        for _ in range(2):
            await one.transfer((read(0x4D, 2),))
        with pytest.raises(OSError, match=rf"another lumiloop \(process {os.getpid()}\) uses address 0x4d") as caught:
            await two.transfer((read(0x4D, 2),))
        assert caught.value.errno == errno.EBUSY
        imports = "from hal.bus.i2c import read; from hal.bus.i2c_remote import open_remote"
        program = f"{imports}; open_remote({where!r}).transfer((read(0x4D, 2),))"
        command = [sys.executable, "-c", program]
        other = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
        _, said = await other.communicate()
        assert f"another lumiloop (process {os.getpid()}) uses address 0x4d" in said.decode()
        await one.close()
        await two.transfer((read(0x4D, 2),))  # free again, without a word to anybody
        await two.close()


async def test_a_link_to_the_socket_is_the_same_bus(tmp_path: Path) -> None:
    async with served("unix", tmp_path) as (where, _, _schedule):
        (tmp_path / "link").symlink_to(where.removeprefix("unix:"))
        one, two = await open_bus(where), await open_bus(f"unix:{tmp_path}/link")
        await one.transfer((read(0x4D, 2),))
        with pytest.raises(OSError, match="another lumiloop"):
            await two.transfer((read(0x4D, 2),))
        await one.close()
        await two.close()


async def test_what_the_server_cannot_open_is_said_to_the_client(tmp_path: Path) -> None:
    async with served("unix", tmp_path) as (where, _, schedule):
        for fault, kind, says in (
            ("what = 'gone'", DeviceMissing, "no such bus"),
            ("what = 'refuse'", DeviceRefused, "permission denied .*group i2c"),
        ):
            schedule.load(f"[[fault]]\n{fault}")
            await asyncio.sleep(0.01)
            with pytest.raises(kind, match=f"{where}: {says}"):
                await open_bus(where)
            schedule.clear()


@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x00\x00\x00\x01\x04",
        b"\x00\x00\x00\x03\x03ab",
        frames.transfer(1, (read(0x4D, 2),)).replace(b"\x4d\x01", b"\x4d\x02"),
        b"\xff" * 100,
    ],
)
async def test_a_client_that_speaks_something_else_is_hung_up_on(garbage: bytes, tmp_path: Path) -> None:
    async with served("unix", tmp_path) as (where, _, _schedule):
        reader, writer = await asyncio.open_unix_connection(where.removeprefix("unix:"))
        writer.write(garbage)
        data = await asyncio.wait_for(reader.read(), 5.0)
        kinds = [kind for kind, _ in frames.Splitter().feed(data)]
        assert kinds[0] == frames.HELLO
        assert len(kinds) <= 2
        writer.close()
        bus = await open_bus(where)  # and nobody else suffers
        assert len((await bus.transfer((read(0x4D, 2),))).reads[0]) == 2
        await bus.close()


async def test_a_client_cannot_order_without_end(tmp_path: Path) -> None:
    async with served("unix", tmp_path) as (where, fake, _schedule):
        _, writer = await asyncio.open_unix_connection(where.removeprefix("unix:"))
        writer.write(frames.transfer(1, (read(0x4D, 8192),)) * 2000)
        await asyncio.sleep(0.5)
        assert fake.bus.transactions <= 5
        writer.close()


async def test_a_server_makes_way_for_itself_only(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    buses = FakeBuses(SystemClock())
    with pytest.raises(DeviceRefused, match="not a socket"):
        await BusServer(buses, "x", SystemClock()).listen(f"unix:{tmp_path}/file")
    with pytest.raises(DeviceRefused, match="cannot listen"):
        await BusServer(buses, "x", SystemClock()).listen(f"unix:{tmp_path}/no/folder")
    with socket.socket(socket.AF_UNIX) as crashed:  # leaves its file behind
        crashed.bind(str(tmp_path / "s"))
    server = BusServer(buses, "x", SystemClock())
    await server.listen(f"unix:{tmp_path}/s")
    await server.close()
    assert not (tmp_path / "s").exists()


def test_the_command_names_what_is_wrong(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hal.bus.i2c_server", "/dev/i2c-250", f"unix:{tmp_path}/s"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 2
    assert done.stderr.startswith("/dev/i2c-250: no such bus (")
