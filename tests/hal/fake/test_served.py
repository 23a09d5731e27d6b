"""The device on a pty and on TCP, in real time, and the command that serves it."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest
import serial

from hal.errors import DataInvalid, DeviceMissing, DeviceRefused
from hal.fake.__main__ import main
from hal.fake.faults.control import Control, serve_control
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import MODELS, URG_04LX, UST_10LX, UTM_30LX, LidarModel
from hal.fake.lidar.scan_world import NO_OBJECT, RecordedRanges, Room
from hal.fake.transport.pty_server import PtyServer
from hal.fake.transport.tcp_server import TcpServer
from tests.hal.fake.bench import ramp, read

ROOT = Path(__file__).parents[3]
MD = b"MD0000108000000\n"
PATIENCE = 4.0
"""Slack for a busy computer."""

pytestmark = pytest.mark.realtime


async def until(true: Callable[[], object], seconds: float = 5.0) -> None:
    deadline = time.monotonic() + seconds * PATIENCE
    while not true():
        assert time.monotonic() < deadline, "waited too long"
        await asyncio.sleep(0.01)


def on_pty(scene: Callable[[FakeHokuyo, PtyServer], Awaitable[None]], link: Path, model: LidarModel = UTM_30LX) -> None:
    async def main() -> None:
        device = FakeHokuyo(model, ramp(model))
        server = PtyServer(device, link)
        try:
            await scene(device, server)
        finally:
            server.close()
            device.close()

    asyncio.run(main())


def opened(path: str, baud: int = 19200) -> serial.Serial:
    return serial.Serial(path, baud, timeout=0, exclusive=True)


async def quiet(port: serial.Serial) -> None:
    """Wait until nothing has come for a while."""
    deadline = time.monotonic() + 5.0 * PATIENCE
    while True:
        port.read(65536)
        await asyncio.sleep(0.3)
        if port.read(65536) == b"":
            return
        assert time.monotonic() < deadline, "it goes on talking"


async def gather(port: serial.Serial, replies: int) -> list[bytes]:
    text = bytearray()

    def enough() -> bool:
        text.extend(port.read(65536))
        return text.count(b"\n\n") >= replies

    await until(enough)
    return [part + b"\n\n" for part in bytes(text).split(b"\n\n")[:replies]]


def test_pty_streams_what_the_world_says(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path) as port:
            port.write(b"VV\n" + MD)
            vv, ack, *scans = await gather(port, 22)
            assert read(vv).pairs["SERI"] == device.unit.serial
            assert read(ack).status == "00"
            for n, scan in enumerate(scans):
                assert read(scan).values() == [1000 + step + 2 * n for step in range(1081)]
            port.write(b"QT\n")
            await until(lambda: device.state is State.IDLE)

    on_pty(scene, tmp_path / "lidar")


def test_pty_goes_on_when_the_host_leaves_and_nothing_stale_is_left(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path) as port:
            port.write(MD)
            await gather(port, 3)
        await until(lambda: device.counts.without_host > 20)
        assert device.state is State.MULTI
        before = device.scans_sent
        with opened(server.path) as port:
            _, scan, *_ = await gather(port, 3)  # the first may be the rest of one
            assert read(scan).values()[0] >= 1000 + 2 * (before - 1)

    on_pty(scene, tmp_path / "lidar")


def test_pty_whose_host_does_not_read_loses_whole_scans(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path) as port:
            port.write(MD)
            await until(lambda: device.counts.refused_by_host > 10)
            scans = [read(data) for data in (await gather(port, 12))[1:]]
            gaps = np.diff([scan.values()[0] for scan in scans]) // 2
            assert gaps[0] == 1
            assert gaps.max() > 10
            assert device.counts.sent > 8

    on_pty(scene, tmp_path / "lidar")


def test_pty_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    link = tmp_path / "lidar"

    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        schedule = FaultSchedule({"lidar": device})
        port = opened(server.path)
        port.write(MD)
        await gather(port, 3)
        schedule.load("[[fault]]\nwhat = 'hangup'\nfor = 0.3")
        await until(lambda: not link.is_symlink())

        def hung_up() -> bool:
            try:
                return os.write(port.fd, b"QT\n") < 0
            except OSError as error:
                return error.errno == errno.EIO

        await until(hung_up)
        port.close()
        await until(link.is_symlink)
        with opened(server.path) as again:
            await until(lambda: device.counts.sent)
            await gather(again, 3)
        schedule.close()

    on_pty(scene, link)


def test_pty_knows_the_rate_of_the_host(tmp_path: Path) -> None:
    async def scene(device: FakeHokuyo, server: PtyServer) -> None:
        with opened(server.path, 57600) as port:
            await until(lambda: device.attached)
            port.write(b"VV\n")
            await quiet(port)
            assert device.counts.sent == 0
            port.baudrate = 19200
            port.write(b"SS250000\n")
            assert await gather(port, 1) == [b"SS250000\n00P\n\n"]
            await until(lambda: device.baud == 250000)
            port.baudrate = 250000
            port.write(b"VV\n")
            assert (await gather(port, 1))[0].startswith(b"VV\n00P\n")

    on_pty(scene, tmp_path / "lidar", URG_04LX)


def test_pty_replaces_a_stale_link_but_nothing_else(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    link.symlink_to("/nonexistent/pts")

    async def scene(_device: FakeHokuyo, server: PtyServer) -> None:
        assert link.resolve().exists()
        assert server.path == str(link)

    on_pty(scene, link)
    assert not link.is_symlink()
    link.write_text("precious")
    with pytest.raises(DeviceRefused, match="no symbolic link"):
        on_pty(scene, link)
    assert link.read_text() == "precious"


Scene = Callable[[FakeHokuyo, TcpServer, int], Awaitable[None]]


def on_tcp(scene: Scene) -> None:
    async def main() -> None:
        device = FakeHokuyo(UST_10LX, ramp(UST_10LX))
        server = TcpServer(device)
        port = await server.listen()
        try:
            await scene(device, server, port)
        finally:
            await server.close()
            device.close()

    asyncio.run(main())


class Client:
    """A connection to the sensor."""

    def __init__(self, port: int) -> None:
        self.port = port

    async def __aenter__(self) -> Client:
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", self.port)
        return self

    async def __aexit__(self, *_: object) -> None:
        self.writer.close()
        with contextlib.suppress(ConnectionError):
            await self.writer.wait_closed()

    async def reply(self) -> bytes:
        return await asyncio.wait_for(self.reader.readuntil(b"\n\n"), 5 * PATIENCE)

    async def end(self) -> bool:
        """Read until the sensor has hung up."""
        try:
            while await asyncio.wait_for(self.reader.read(100), 5 * PATIENCE):
                pass
        except ConnectionResetError:
            pass
        return True


def test_tcp_one_host_at_a_time_and_a_closed_connection_stops_the_sensor() -> None:
    async def scene(device: FakeHokuyo, server: TcpServer, port: int) -> None:
        async with Client(port) as first:
            first.writer.write(MD)
            for _ in range(10):
                reply = await first.reply()
            assert len(read(reply).values()) == 1081
            async with Client(port) as second:
                assert await second.end()
            assert server.rejected == 1
            assert read(await first.reply()).status == "99"
        await until(lambda: device.state is State.IDLE)
        async with Client(port) as third:
            third.writer.write(b"BM\n")
            assert await third.reply() == b"BM\n00P\n\n"

    on_tcp(scene)


def test_tcp_drops_at_reboot_and_comes_back() -> None:
    async def scene(device: FakeHokuyo, _server: TcpServer, port: int) -> None:
        async with Client(port) as host:
            host.writer.write(b"RB\nRB\n")
            assert await host.end()
            assert not device.reachable
        async with Client(port) as early:
            assert await early.end()
        await until(lambda: device.state is State.IDLE)
        async with Client(port) as host:
            host.writer.write(b"QT\n")
            assert await host.reply() == b"QT\n00P\n\n"

    on_tcp(scene)


def test_tcp_host_that_does_not_read() -> None:
    async def scene(device: FakeHokuyo, _server: TcpServer, port: int) -> None:
        schedule = FaultSchedule({"lidar": device})
        schedule.load("[[fault]]\nwhat = 'slow'\nfactor = 0.1")
        with socket.create_connection(("127.0.0.1", port)) as slow:
            slow.sendall(b"NE0000108000000\n")
            await until(lambda: device.counts.refused_by_host, 15.0)
        schedule.close()

    on_tcp(scene)


def test_room_is_seen_as_it_is() -> None:
    """The back wall and the right-hand wall, as the sensor sees them from where it is."""
    room = Room(UTM_30LX, noise_mm=0.0)
    scan = room(0.0)
    x, y, heading = room.pose(np.array([540 / 1440 * UTM_30LX.true_period_s]))[0]
    assert heading == pytest.approx(np.pi / 2, abs=0.01)  # looking along +y
    ahead, right = scan.ranges_mm[540], scan.ranges_mm[540 - 360]
    assert ahead == pytest.approx(1e3 * (5.0 - y), abs=5)
    assert right == pytest.approx(1e3 * (7.0 - x), abs=5)
    assert room(15.0).ranges_mm[540] != ahead
    assert scan.ranges_mm.min() > 300
    assert np.array_equal(Room(UTM_30LX, seed=3)(1.0).ranges_mm, Room(UTM_30LX, seed=3)(1.0).ranges_mm)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_room_fits_every_model(model: LidarModel) -> None:
    scan = Room(model)(0.0)
    assert scan.ranges_mm.shape == (model.steps,)
    seen = scan.ranges_mm != NO_OBJECT
    assert seen.mean() > 0.5
    assert scan.ranges_mm[seen].min() >= model.dmin
    assert scan.ranges_mm[seen].max() <= model.dmax


def test_recorded_ranges(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    rows = np.arange(3 * 682, dtype=np.float64).reshape(3, 682)
    rows[0, 0] = np.nan
    np.savez(path, range_mm=rows)
    source = RecordedRanges(path, URG_04LX)
    scans = [source(float(k)) for k in range(4)]
    assert scans[3] is None
    assert scans[0] is not None
    assert scans[1] is not None
    assert scans[0].ranges_mm[:46].tolist() == [0] * 45 + [1]
    assert scans[1].ranges_mm[44:].tolist() == rows[1].tolist()


def test_recorded_ranges_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissing, match="no such file"):
        RecordedRanges(tmp_path / "nothing.npz", UTM_30LX)
    path = tmp_path / "log.npz"
    np.savez(path, range_mm=np.zeros((3, 682)))
    with pytest.raises(DataInvalid, match=r"is 3x682, UTM-30LX.* has 1081 steps \(choose the --model"):
        RecordedRanges(path, UTM_30LX)
    np.savez(path, ranges=np.zeros((3, 682)))
    with pytest.raises(DataInvalid, match="no array `range_mm`"):
        RecordedRanges(path, URG_04LX)
    path.write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(DataInvalid, match=r"log\.npz"):
        RecordedRanges(path, URG_04LX)


def command(*words: str) -> list[str]:
    return [sys.executable, "-W", "error", "-m", "hal.fake", *words]


def test_command_serves_takes_orders_and_ends(tmp_path: Path) -> None:
    link, control, faults = tmp_path / "lidar", tmp_path / "control", tmp_path / "faults.toml"
    faults.write_text("[[fault]]\nwhat = 'trouble'\n")
    words = command("--model", "UTM-30LX", "--pty", str(link), "--faults", str(faults), "--control", str(control))
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert [process.stdout.readline() for _ in range(3)] == [
            f"1 faults of {faults} ordered\n",
            f"UTM-30LX on {link}\n",
            f"fault orders on {control}\n",
        ]

        async def talk() -> None:
            with opened(str(link)) as port:
                port.write(b"II\n" + MD)
                ii, _, scan = await gather(port, 3)
                assert "Trouble!!" in read(ii).pairs["STAT"]
                assert len(read(scan).values()) == 1081
                reader, writer = await asyncio.open_unix_connection(str(control))
                writer.write(b"order silence\nlist\n")
                assert await reader.readline() == b"ordered lidar:silence\n"
                assert await reader.readline() == b"ok\n"
                await quiet(port)
                writer.close()

        asyncio.run(talk())
        process.send_signal(signal.SIGTERM)
        out, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, "")
    assert "scans made" in out
    assert not link.is_symlink()


def test_command_in_this_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "log.npz", range_mm=np.full((2, 1081), 1000))
    world, socket_ = str(tmp_path / "log.npz"), str(tmp_path / "control")
    assert main(["--model", "UST-20LX", "--tcp", "127.0.0.1:0", "--world", world, "--cold", "--seconds", "0.1"]) == 0
    assert main(["--control", socket_, "--seconds", "0.1"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^UST-20LX on tcp://127\.0\.0\.1:\d+\n0 scans made", out)
    assert "UTM-30LX on /dev/pts/" in out
    assert f"fault orders on {socket_}\n" in out
    assert main(["--tcp", "nowhere"]) == main(["--pty", "a", "--tcp", "b:1"]) == main(["--world", "none.npz"]) == 2


def test_control_socket(tmp_path: Path) -> None:
    path = tmp_path / "control"

    async def scene(device: FakeHokuyo, _server: PtyServer) -> None:
        schedule = FaultSchedule({"lidar": device})
        for _ in range(2):  # the second time over a stale socket
            server = await serve_control(Control(schedule), path)
            reader, writer = await asyncio.open_unix_connection(str(path))
            writer.write(b"order silence\nclear\n")
            assert await reader.readline() == b"ordered lidar:silence\n"
            writer.write(b"x" * 100_000 + b"\n")  # no line of orders is that long: the connection is closed
            while await reader.read(1000):
                pass
            writer.close()
            server.close()
        schedule.close()

    on_pty(scene, tmp_path / "lidar")
    path.unlink(missing_ok=True)
    path.write_text("precious")
    with pytest.raises(DeviceRefused, match="no socket"):
        on_pty(lambda device, _: serve_control(Control(FaultSchedule({"lidar": device})), path), tmp_path / "lidar")  # type: ignore[arg-type,return-value]  # never gets to a server


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--world", "nothing.npz"], "nothing.npz: no such file"),
        (["--faults", "nothing.toml"], "nothing.toml"),
        (["--pty", "a", "--tcp", "127.0.0.1:0"], "give --pty or --tcp"),
        (["--tcp", "127.0.0.1"], "expected HOST:PORT"),
        (["--tcp", "127.0.0.1:70000"], "expected HOST:PORT"),
        (["--tcp", ":10940"], "expected HOST:PORT"),
        (["--faults", "pyproject.toml"], "build-system: a schedule holds [[fault]] tables"),
        (["--model", "LMS"], "invalid choice: 'LMS'"),
    ],
)
def test_command_refuses_clearly(words: list[str], message: str) -> None:
    done = subprocess.run(command(*words), cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
