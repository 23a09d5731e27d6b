"""The client of a remote bus, over real unix and TCP sockets."""

import asyncio
import errno
import os
import socket
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from hal.adc import RawSamples
from hal.bus import i2c_frames as frames
from hal.bus.i2c import read, write
from hal.bus.i2c_remote import RemoteClock, open_remote, parse_address
from hal.bus.opening import open_bus
from hal.clock import SystemClock
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.photodiode.driver import PhotodiodeAdc
from tests.hal.bus.remote_bus import KINDS, Server, answer, greet, served
from tests.hal.photodiode.bench import Bench, Light, falsehoods


@pytest.mark.parametrize("kind", KINDS)
async def test_transactions(kind: str, tmp_path: Path) -> None:
    async with served(kind, tmp_path) as (where, fake, _):
        bus = await open_bus(where)
        assert bus.name == where
        assert bus.about == fake.bus.adapter.name
        before = time.monotonic()
        done = await bus.transfer((read(0x4D, 900),))
        assert before <= done.t0 < done.t1 <= time.monotonic()
        assert done.t1 - done.t0 == pytest.approx(8110 / 400e3, abs=1e-3)
        words = [int.from_bytes(done.reads[0][k : k + 2], "big") for k in range(0, 900, 2)]
        expected = [int(4096 * ((t * 5.0) % 1.0)) for t in (done.t0, done.t1)]
        assert abs(words[0] - expected[0]) % 4090 < 8
        assert abs(words[-1] - expected[1]) % 4090 < 8
        await bus.close()


async def test_errors_come_through_with_their_errno(tmp_path: Path) -> None:
    async with served("unix", tmp_path) as (where, _, schedule):
        bus = await open_bus(where)
        for name in ("EIO", "EREMOTEIO", "EAGAIN", "EOPNOTSUPP", "ENXIO"):
            schedule.load(f"[[fault]]\nwhat = 'error'\nname = '{name}'\non = 'all'")
            await asyncio.sleep(0.01)
            with pytest.raises(OSError, match=os.strerror(getattr(errno, name))) as caught:
                await bus.transfer((read(0x4D, 2),))
            assert caught.value.errno == getattr(errno, name)
            schedule.clear()
        with pytest.raises(OSError, match="Remote I/O") as caught:
            await bus.transfer((write(0x4D, b"\x01"),))
        assert len((await bus.transfer((read(0x4D, 2),))).reads[0]) == 2
        with pytest.raises(OSError, match="8193 bytes"):
            await bus.transfer((read(0x4D, 8193),))
        await bus.close()


@pytest.mark.realtime
@pytest.mark.system  # the pauses are few milliseconds: it has the machine to itself
@pytest.mark.parametrize("kind", KINDS)
async def test_blocks_follow_each_other_without_waiting_for_the_client(kind: str, tmp_path: Path) -> None:
    async with served(kind, tmp_path) as (where, _, _schedule):
        bus = await open_bus(where)
        got: list[tuple[float, float]] = []
        task = asyncio.create_task(bus.stream((read(0x4D, 2222),), lambda done, _: got.append((done.t0, done.t1))))
        await asyncio.sleep(1.5)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await bus.close()
        assert len(got) > 7
        assert sorted(got) == got
        pauses = sorted(late[0] - early[1] for early, late in pairwise(got))
        assert pauses[len(pauses) // 2] < 4 * 2e-3


@pytest.mark.realtime
@pytest.mark.parametrize("kind", KINDS)
async def test_the_driver_over_a_socket(kind: str, tmp_path: Path) -> None:
    """The whole chain in real time: the words are the light's, at the times it had them."""
    light = Light()
    async with served(kind, tmp_path, light) as (where, _, _schedule):
        clock = SystemClock()
        blocks: list[RawSamples] = []
        driver = PhotodiodeAdc(where, 0x4D, "MCP3221", clock=clock, opener=open_bus)
        task = asyncio.create_task(driver.run(blocks.append))
        end = clock.now() + 4 * 3.0
        while len(blocks) < 20:
            assert clock.now() < end, driver.status
            await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert falsehoods(Bench(clock, open_bus, light=light), blocks, rate_error=0.05) == []
        assert driver.status.error is None


@pytest.mark.realtime
@pytest.mark.system
async def test_the_driver_survives_its_server(tmp_path: Path) -> None:
    clock = SystemClock()
    blocks: list[RawSamples] = []
    where = f"unix:{tmp_path}/i2c"
    driver = PhotodiodeAdc(where, 0x4D, "MCP3221", clock=clock, opener=open_bus)
    task = asyncio.create_task(driver.run(blocks.append))
    await asyncio.sleep(0.1)
    assert isinstance(driver.status.error, DeviceMissing)
    for _ in range(2):
        seen = len(blocks)
        async with served("unix", tmp_path):
            end = clock.now() + 4 * 3.0
            while len(blocks) < seen + 3:
                assert clock.now() < end, driver.status
                await asyncio.sleep(0.01)
            assert driver.status.error is None
        await asyncio.sleep(0.3)
        assert "bus server has closed the connection" in str(driver.status.error)
    await asyncio.sleep(2.0)
    assert "start the bus server" in str(driver.status.error)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


# the client against servers that misbehave


@pytest.mark.parametrize(
    ("behave", "kind", "says"),
    [
        (lambda link: None, DeviceFault, "no hello message: the bus server has closed"),
        (lambda link: link.sendall(b"SSH-2.0-OpenSSH_9.2\r\n"), DeviceRefused, "not an I2C bus server"),
        (lambda link: link.sendall(b"\x00\x00\x00\x01\x07"), DeviceRefused, "not an I2C bus server"),
        (lambda link: link.sendall(frames.hello(0.0, "a", "b")[:-1] + b"\xff"), DeviceRefused, "UTF-8"),
    ],
)
def test_greetings_that_are_none(
    behave: Callable[[socket.socket], None], kind: type[HalError], says: str, tmp_path: Path
) -> None:
    server = Server(tmp_path / "s", behave)
    with pytest.raises(kind, match=says):
        open_remote(f"unix:{tmp_path}/s")
    server.join()


def test_a_connection_that_is_lost_in_the_middle(tmp_path: Path) -> None:
    server = Server(tmp_path / "s", lambda link: (greet(link), answer(link), None)[-1])
    bus = open_remote(f"unix:{tmp_path}/s")
    bus.transfer((read(0x4D, 2),))
    for _ in range(2):
        with pytest.raises(OSError, match="bus server") as caught:
            bus.transfer((read(0x4D, 2),))
        assert caught.value.errno == errno.ENODEV
    server.join()


def test_an_answer_that_is_none(tmp_path: Path) -> None:
    def behave(link: socket.socket) -> None:
        greet(link)
        link.recv(100)
        link.sendall(b"\x00\x00\x00\x02\x04\x00")
        link.recv(100)

    server = Server(tmp_path / "s", behave)
    bus = open_remote(f"unix:{tmp_path}/s")
    with pytest.raises(OSError, match="too short") as caught:
        bus.transfer((read(0x4D, 2),))
    assert caught.value.errno == errno.EPROTO
    with pytest.raises(OSError, match="closed"):
        bus.transfer((read(0x4D, 2),))
    server.join()


def test_a_server_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hal.bus.i2c_remote.REPLY_S", 0.05)
    server = Server(tmp_path / "s", lambda link: (greet(link), link.recv(100), link.recv(100), None)[-1])
    bus = open_remote(f"unix:{tmp_path}/s")
    with pytest.raises(TimeoutError, match="does not answer"):
        bus.transfer((read(0x4D, 2),))
    bus.close()
    server.join()


async def test_a_bus_that_is_closed_while_nothing_is_answered_hangs_up(tmp_path: Path) -> None:
    """What the server has open for it, an address above all, is free for the next connection."""
    hung_up = threading.Event()

    def behave(link: socket.socket) -> None:
        greet(link)
        while link.recv(100):
            pass
        hung_up.set()

    server = Server(tmp_path / "s", behave)
    bus = await open_bus(f"unix:{tmp_path}/s")
    waiting = asyncio.create_task(bus.transfer((read(0x4D, 2),)))
    await asyncio.sleep(0.05)
    await bus.close()
    assert await asyncio.to_thread(hung_up.wait, 1.0)
    with pytest.raises(OSError, match="bus server"):
        await waiting
    server.join()


def test_times_of_another_computer_are_translated(tmp_path: Path) -> None:
    def behave(link: socket.socket) -> None:
        greet(link, "another clock")
        for _ in range(20):
            answer(link, shift=12345.0)

    server = Server(tmp_path / "s", behave)
    bus = open_remote(f"unix:{tmp_path}/s")
    for _ in range(20):
        before = time.monotonic()
        done = bus.transfer((read(0x4D, 2),))
        after = time.monotonic()
        assert before - 0.05 < done.t0 <= done.t1 < after + 0.05
    bus.close()
    server.join()


def test_the_difference_of_clocks_is_bounded_from_both_sides() -> None:
    clock = RemoteClock(same=False)
    clock.add(ordered=10.0, received=110.5, sent=110.6, answered=10.7)  # between 99.9 and 100.5
    clock.add(ordered=20.0, received=120.2, sent=120.3, answered=20.4)  # between 99.9 and 100.2
    assert clock.to_local(150.05) == pytest.approx(50.0)
    assert RemoteClock(same=True).to_local(5.0) == 5.0


@pytest.mark.parametrize(
    ("name", "address"),
    [
        ("unix:/run/x", "/run/x"),
        ("tcp://robot", ("robot", 10941)),
        ("tcp://127.0.0.1:7", ("127.0.0.1", 7)),
        ("tcp://[::1]:7", ("::1", 7)),
    ],
)
def test_addresses(name: str, address: object) -> None:
    assert parse_address(name) == address


@pytest.mark.parametrize("name", ["unix:", "tcp://", "tcp://:5", "tcp://host:port", "tcp:host", "http://host"])
def test_what_is_no_address(name: str) -> None:
    with pytest.raises(DeviceRefused, match="expected unix:/path or tcp://host:port"):
        parse_address(name)


def test_why_there_is_no_connection(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissing, match=r"no bus server runs there .start the bus server"):
        open_remote(f"unix:{tmp_path}/none")
    with pytest.raises(DeviceMissing, match="host name is not known"):
        open_remote("tcp://no-such-host.invalid:1")
    with pytest.raises(DeviceMissing, match="not a host name"):
        open_remote("tcp://robot..local:1")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(DeviceMissing, match="no bus server runs there"):
        open_remote(f"tcp://127.0.0.1:{port}")
    datagrams = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    datagrams.bind(str(tmp_path / "d"))
    with datagrams, pytest.raises(DeviceRefused, match="not a stream socket"):
        open_remote(f"unix:{tmp_path}/d")
