"""The remote bus among strangers: servers that lie, clients without end, addresses open to everyone."""

import asyncio
import errno
import random
import socket
import stat
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from hal.bus import i2c_frames as frames
from hal.bus.i2c import read, write
from hal.bus.i2c_remote import RemoteClock, open_remote
from hal.bus.i2c_server import CLIENTS, BusServer
from hal.bus.opening import open_bus
from hal.clock import SystemClock
from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.fake.adc.converter import FakeBuses
from hal.photodiode.driver import PhotodiodeAdc
from tests.hal.bus.remote_bus import Server, greet, served

Reads = tuple[bytes, ...]


def lie(reads: Reads = (bytes(2),), number: int = 1, shift: float = 0.0) -> Callable[[socket.socket], None]:
    """Greets, then answers the first order with this."""

    def behave(link: socket.socket) -> None:
        greet(link)
        link.recv(4096)
        now = time.monotonic() + shift
        link.sendall(frames.done(frames.Done(number, 0, now, now, now, now, reads)))
        link.recv(4096)

    return behave


@pytest.mark.parametrize(
    ("behave", "says"),
    [
        (lie(reads=()), r"reads of \(\) bytes where \(2,\) were requested"),
        (lie(reads=(bytes(2), bytes(2))), "were requested"),
        (lie(reads=(bytes(3),)), "were requested"),
        (lie(number=7), "a reply to request 7"),
        (lie(shift=-10.0), "times before the request or after the reply"),
        (lie(shift=10.0), "times before the request or after the reply"),
    ],
)
def test_a_server_that_lies_is_left(behave: Callable[[socket.socket], None], says: str, tmp_path: Path) -> None:
    server = Server(tmp_path / "s", behave)
    with closing(open_remote(f"unix:{tmp_path}/s")) as bus:
        with pytest.raises(OSError, match=says) as caught:
            bus.transfer((write(0x48, b"\x01"), read(0x48, 2)))
        assert caught.value.errno == errno.EPROTO
        with pytest.raises(OSError, match="closed"):
            bus.transfer((read(0x48, 2),))
    server.join()


def test_fewer_bytes_are_no_lie(tmp_path: Path) -> None:
    server = Server(tmp_path / "s", lie(reads=(bytes(1),)))
    with closing(open_remote(f"unix:{tmp_path}/s")) as bus:
        assert bus.transfer((read(0x48, 2),)).reads == (bytes(1),)
    server.join()


async def test_the_driver_survives_any_server(tmp_path: Path) -> None:
    """Answers at random, for as long as it asks; then a true one at the same address."""
    path = tmp_path / "i2c"

    async def lying(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        chance = random.Random(1)
        writer.write(frames.hello(time.monotonic(), "", "liar"))
        splitter = frames.Splitter()
        with closing(writer):  # also where it is ended in the middle
            while data := await reader.read(4096):
                for _, body in splitter.feed(data):
                    number, messages = frames.parse_transfer(body)
                    lengths = [chance.choice((m.length, m.length, m.length, 1, 0)) for m in messages if m.length]
                    now = time.monotonic()
                    code = chance.choice((0, 0, 0, 0, 0, 5, 6, 110, 9999))
                    reads = tuple(chance.randbytes(n) for n in lengths[: chance.choice((1, 1, 1, 0))])
                    writer.write(frames.done(frames.Done(number, code, now, now, now + 1e-3, now + 1e-3, reads)))

    liar = await asyncio.start_unix_server(lying, str(path))
    driver = PhotodiodeAdc(f"unix:{path}", 0x4D, "MCP3221", clock=SystemClock(), opener=open_bus)
    running = asyncio.create_task(driver.run(lambda block: None))
    await asyncio.sleep(1.5)
    assert not running.done()
    assert driver.status.error is not None
    assert driver.status.error.remedy
    liar.close()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def test_a_step_of_the_other_clock_is_followed() -> None:
    clock = RemoteClock(same=False)
    for k in range(10):
        clock.add(k + 0.0, k + 100.01, k + 100.02, k + 0.03)
    assert clock.to_local(150.0) == pytest.approx(50.0, abs=0.02)
    for k in range(10, 12):
        clock.add(k + 0.0, k + 700.01, k + 700.02, k + 0.03)
    assert clock.to_local(750.0) == pytest.approx(50.0, abs=0.02)


def server() -> BusServer:
    return BusServer(FakeBuses(SystemClock()), "x", SystemClock())


@pytest.mark.parametrize("where", ["tcp://0.0.0.0:0", "tcp://[::]:0", "tcp://192.0.2.1:0"])
def test_nobody_is_served_from_outside_without_being_asked(where: str) -> None:
    with pytest.raises(DeviceRefused, match=r"every client of that address could write to all .*ssh -L.*--anyone"):
        asyncio.run(server().listen(where))


async def test_anyone_is_served_where_that_was_said() -> None:
    open_to_all = BusServer(FakeBuses(SystemClock()), "x", SystemClock(), anyone=True)
    assert (await open_to_all.listen("tcp://0.0.0.0:0")).startswith("tcp://0.0.0.0:")
    await open_to_all.close()


@pytest.mark.parametrize("where", ["tcp://127.0.0.1:0", "tcp://localhost:0"])
async def test_this_computer_is_served(where: str) -> None:
    one = server()
    assert "tcp://" in await one.listen(where)
    await one.close()


def test_an_unknown_host() -> None:
    with pytest.raises(HalError, match="host name not known"):
        asyncio.run(server().listen("tcp://no-such-host.invalid:0"))


async def test_a_unix_socket_is_its_owners(tmp_path: Path) -> None:
    one, other = server(), server()
    await one.listen(f"unix:{tmp_path}/s")
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o600
    with pytest.raises(DeviceRefused, match="another server listens there"):
        await other.listen(f"unix:{tmp_path}/s")
    await other.close()
    assert (tmp_path / "s").exists()  # what it did not make it does not remove
    await one.close()


async def test_clients_without_end(tmp_path: Path) -> None:
    async with served("unix", tmp_path) as (where, _, _schedule):
        buses = [await open_bus(where) for _ in range(CLIENTS)]
        with pytest.raises(DeviceRefused, match=f"{CLIENTS} clients are connected already"):
            await open_bus(where)
        for bus in buses:
            await bus.close()
        await asyncio.sleep(0.1)
        again = await open_bus(where)
        await again.close()


async def test_a_bus_behind_the_server_that_is_missing(tmp_path: Path) -> None:
    one = server()
    await one.listen(f"unix:{tmp_path}/s")
    with pytest.raises(DeviceMissing, match=f"unix:{tmp_path}/s: no such bus"):
        await open_bus(f"unix:{tmp_path}/s")
    await one.close()
