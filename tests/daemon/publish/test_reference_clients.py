"""The reference clients against the daemon's own ends: written from the documents, they share no code with it."""

import asyncio
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from daemon.publish.modbus import lights_block, registers
from daemon.publish.modbus.holding import CommandCode, Outcome, Request
from daemon.publish.udp_sender import PoseSender
from daemon.publish.udp_subscriptions import Subscriptions
from daemon.snapshot import LightFix, LinkUse, Trust
from hal.clock import SystemClock
from hal.imu import RawImu
from hal.net.inputs import InputPort
from hal.odometry import RawOdometry
from tests.daemon.publish.modbus.test_light_blocks import picture
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import publishing, until
from tools.clients import read_lights, read_modbus, send_command, send_odometry, subscribe_pose

CLIENTS = Path(read_modbus.__file__).parent


@pytest.mark.parametrize("path", sorted(CLIENTS.glob("*.*")), ids=lambda path: path.name)
def test_clients_are_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) < 100


@pytest.mark.parametrize("tcp", [False, True])
def test_modbus_reader(tcp: bool) -> None:
    def read(port: int) -> list[dict[str, float | int | str | None]]:
        reader = read_modbus.Reader("127.0.0.1", port, tcp)
        try:
            return [reader.read() for _ in range(3)]
        finally:
            reader.close()

    async def run() -> list[dict[str, float | int | str | None]]:
        async with publishing() as publisher:
            return await asyncio.to_thread(read, publisher.port)

    for reading in asyncio.run(run()):
        assert reading == {
            "seq": 70_000, "state": "TRACKING", "reason": 7, "fault": 9, "x_known": 1, "y_known": 0, "yaw_known": 1,
            "bounded": 0, "alert": 0, "age": 0.025, "x": 1.2345, "y": -2.3456, "yaw": 3.0,
            "sigma_x": 0.02, "sigma_y": 0.01, "sigma_yaw": 0.01, "jumps": 3, "loops": 2, "t_mono": 1234.5,
        }  # fmt: skip


def test_modbus_reader_without_a_pose() -> None:
    block = registers.encode_block(snapshot(pose=None, covariance=None))
    reading = read_modbus.decode(bytes(9) + block)
    assert (reading["x"], reading["y"], reading["yaw"], reading["sigma_x"]) == (None, None, None, None)
    with pytest.raises(ValueError, match="torn"):
        read_modbus.decode(bytes(9) + block[:-1] + b"\x00")
    with pytest.raises(ValueError, match="exception 2"):
        read_modbus.decode(b"\x00\x01\x00\x00\x00\x03\x01\x84\x02")


def test_lights_reader() -> None:
    def read(port: int) -> dict[str, object]:
        reader = read_lights.Reader("127.0.0.1", port)
        try:
            return reader.read()
        finally:
            reader.close()

    async def run() -> tuple[dict[str, object], dict[str, object]]:
        async with publishing() as publisher:
            dark = await asyncio.to_thread(read, publisher.port)
            publisher.publish(snapshot(light=picture(), links=3))
            return dark, await asyncio.to_thread(read, publisher.port)

    dark, reading = asyncio.run(run())
    assert dark["fix"] is None
    assert dark["links"] == []
    told = lights_block.BLOCK.decode(lights_block.BLOCK.encode(snapshot(light=picture(), links=3)))
    for name in ("x", "y", "yaw", "sigma_x", "sigma_y", "sigma_yaw", "used"):
        assert reading[name] == told[f"light_{name}"]
    assert reading["fix"] == "GOOD"
    assert reading["links"] == [
        {"code": 17, "lamp": 1017, "use": "ACCEPTED", "strength": 1.25e-6, "residual": -0.031},
        {"code": 60, "lamp": None, "use": "TWIN", "strength": 0.5e-6, "residual": None},
        {"code": 101, "lamp": 65_000, "use": "OCCLUDED", "strength": 3.1e-9, "residual": -3.2767},
    ]


def test_lights_reader_refuses_what_is_no_block_of_lights() -> None:
    block = lights_block.BLOCK.encode(snapshot(light=picture()))
    with pytest.raises(ValueError, match="torn"):
        read_lights.decode(bytes(9) + block[:-1] + bytes([block[-1] ^ 1]))
    with pytest.raises(ValueError, match="exception 2"):
        read_lights.decode(b"\x00\x01\x00\x00\x00\x03\x01\x84\x02")


def test_the_lights_reader_knows_every_name_of_the_document() -> None:
    assert tuple(fix.name for fix in LightFix) == read_lights.FIXES
    assert tuple(use.name for use in LinkUse) == read_lights.USES


async def test_odometry_sender() -> None:
    odometry: list[RawOdometry] = []
    imu: list[RawImu] = []
    port = InputPort(SystemClock(), "127.0.0.1", 0)
    tasks = [asyncio.create_task(port.odometry.run(odometry.append)), asyncio.create_task(port.imu.run(imu.append))]
    await asyncio.sleep(0.01)
    sender = send_odometry.Sender("127.0.0.1", port.port, shared_clock=True)
    for number in range(5):
        sender.odometry(float(number), -1.0, 0.5, time.monotonic() - 0.01)
        sender.imu(0.25)
    sender.close()
    await asyncio.sleep(0.05)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert port.invalid == 0
    assert [(o.x, o.y, o.yaw) for o in odometry] == [(float(n), -1.0, 0.5) for n in range(5)]
    assert all(o.t_rx - o.t_mono >= 0.009 for o in odometry), "the sender's time is used, not the arrival"
    assert [i.yaw_rate for i in imu] == [0.25] * 5


async def test_subscriber() -> None:
    def read(port: int, ready: threading.Event) -> list[dict[str, float | int | str | None]]:
        subscription = subscribe_pose.Subscription("127.0.0.1", port)
        taken = []
        for pose in subscription.poses():
            taken.append(pose)
            ready.set()
            if len(taken) == 3:
                break
        subscription.close()
        return taken

    server = Subscriptions("127.0.0.1", 0, lambda _: True)
    await server.start()
    sender = PoseSender([], "", server)
    reading = asyncio.create_task(asyncio.to_thread(read, server.port, threading.Event()))
    number = 0
    async with asyncio.timeout(10.0):
        while not reading.done():
            number += len(server.leases)
            sender.publish(snapshot(seq=number, pose=None if number == 2 else (1.2345, -2.3456, 3.0)))
            await asyncio.sleep(0.01)
        await until(lambda: len(server.leases) == 0)
    await server.close()
    first, second, third = reading.result()
    assert first == {
        "seq": first["seq"], "state": "TRACKING", "reason": 7, "fault": 9, "x": 1.2345, "y": -2.3456, "yaw": 3.0,
    }  # fmt: skip
    assert (second["seq"], second["x"], third["seq"]) == (2, None, 3)


def test_subscriber_passes_over_what_is_no_pose() -> None:
    good = registers.encode_datagram(snapshot())
    for bad in (b"", good[:50], good[:-1] + bytes([good[-1] ^ 1]), b"LUSB" + good[4:], good + b"\x00"):
        assert subscribe_pose.decode(bad) is None


@pytest.mark.parametrize("name", send_command.COMMANDS)
def test_commander(name: str) -> None:
    asked: list[Request] = []

    def give(port: int) -> str:
        commander = send_command.Commander("127.0.0.1", port)
        try:
            return commander.wait(commander.order(name, (1.25, -2.5, 0.5), 0x1A2B3C4D), 5.0)
        finally:
            commander.close()

    async def run() -> str:
        async with publishing(write=True, on_command=asked.append) as publisher:
            giving = asyncio.create_task(asyncio.to_thread(give, publisher.port))
            await until(lambda: bool(asked))
            publisher.acknowledge(asked[0].number, Outcome.REFUSED)
            return await giving

    assert asyncio.run(run()) == "refused"
    (request,) = asked
    assert (request.code.name, request.pose) == (name.upper(), (1.25, -2.5, 0.5))
    assert request.map_id == (0x1A2B3C4D if name == "switch_map" else 0)


async def test_commander_where_writing_is_not_allowed() -> None:
    async with publishing() as publisher:
        commander = send_command.Commander("127.0.0.1", publisher.port)
        with pytest.raises(ValueError, match=r"exception 2 \(set modbus\.write = true\)"):
            await asyncio.to_thread(commander.order, "reset")
        commander.close()


@pytest.mark.parametrize(
    "words", ["", "fly", "switch_map", "switch_map xyz", "set_pose 1 2", "set_pose 1 2 here", "save_map ::1 1502 x"]
)
def test_commander_says_what_it_cannot_read(words: str) -> None:
    with pytest.raises(ValueError, match="Commands: set_pose, reset"):
        send_command.main(words.split())


@pytest.mark.parametrize("words", ["set_pose 1e9 0 0", "set_pose 0 inf 0", "set_pose 0 0 nan", "switch_map 100000000"])
def test_commander_says_what_does_not_fit(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(send_command.Commander, "_ask", lambda self, body: bytes(4))
    with pytest.raises(ValueError, match="out of range: metres to 214748"):
        send_command.main(words.split())


def test_commander_where_nobody_listens() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    command = [sys.executable, send_command.__file__, "SAVE_MAP", "127.0.0.1", str(port)]
    told = subprocess.run(command, capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert told.stderr.endswith("is lumiloop running, and do `bind` and `allow` admit this machine?\n")
    assert "Traceback" not in told.stderr


def test_the_commander_knows_every_name_of_the_document() -> None:
    assert [code.name.lower() for code in CommandCode] == list(send_command.COMMANDS)
    assert [outcome.name.lower() for outcome in Outcome] == list(send_command.RESULTS)


def test_listener_in_c(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this computer")
    program = tmp_path / "listen_pose"
    flags = ["-std=c99", "-D_POSIX_C_SOURCE=200809L", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run([compiler, *flags, "-o", program, CLIENTS / "listen_pose.c"], check=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    good = registers.encode_datagram(snapshot(trust=Trust(0.25, 0.1, 0.2, alert=True)))
    blind = registers.encode_datagram(snapshot(pose=None, seq=2))
    rubbish = [b"", b"LUMI", good[:-1] + bytes([good[-1] ^ 1]), good[:4] + b"\x02" + good[5:], good + b"\x00"]
    with (
        subprocess.Popen(
            [program, str(port), str(2 + len(rubbish))], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as listener,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
    ):
        try:
            wait_until_bound(port)
            for data in (good, *rubbish, blind):
                sock.sendto(data, ("127.0.0.1", port))
            out, err = listener.communicate(timeout=10)
        finally:
            listener.kill()
    assert out.splitlines() == [
        "seq 70000 t_mono 1234.500000 TRACKING x 1.2345 y -2.3456 yaw 3.000000 age 0.0250 sigma 0.0200 0.0100 0.0100"
        " bound 0.250 ALERT",
        "seq 2 t_mono 1234.500000 TRACKING no pose",
    ]
    words = ("not a pose datagram", "not a pose datagram", "damaged", "another version", "wrong length")
    assert err.splitlines() == [f"dropped: {word}" for word in words]


def wait_until_bound(port: int) -> None:
    """Until the port cannot be bound any more: the listener has it."""
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("0.0.0.0", port))
            except OSError:
                return
        time.sleep(0.01)
    raise TimeoutError("the listener does not listen")
