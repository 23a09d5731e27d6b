"""Odometry datagrams and ground truth, in virtual time and over loopback sockets; the process from outside."""

from __future__ import annotations

import asyncio
import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hal.clock import run_virtual
from hal.net.input_codec import SHARED_CLOCK, InputDatagram, decode
from tools.sim.feed import TumWriter, UdpSender, feed_odometry, feed_truth, udp_target
from tools.sim.run import main
from tools.sim.scene import PAPER, SimulatedScene


async def gather_for(seconds: float, scene: SimulatedScene) -> tuple[list[InputDatagram], list[float]]:
    """Datagrams and when they were sent."""
    loop = asyncio.get_running_loop()
    sent: list[tuple[float, bytes]] = []
    task = asyncio.create_task(feed_odometry(scene, lambda data: sent.append((loop.time(), data)), session=7))
    await asyncio.sleep(1.0)
    scene.scan(loop.time())
    await asyncio.sleep(seconds)
    task.cancel()
    return [decode(data) for _, data in sent], [t for t, _ in sent]


def test_odometry_datagrams_tell_when_each_reading_was_true() -> None:
    scene = SimulatedScene(PAPER)
    datagrams, times = run_virtual(gather_for(5.0, scene), start=1000.0)
    assert [datagram.seq for datagram in datagrams] == list(range(len(datagrams)))
    assert {(datagram.session, datagram.flags) for datagram in datagrams} == {(7, SHARED_CLOCK)}
    np.testing.assert_allclose([datagram.time for datagram in datagrams], times, atol=1e-9)
    assert len(datagrams) == pytest.approx(6.0 * 50, abs=3)
    moving = scene.truth(np.array(times))[-1] - scene.truth(np.array(times))[0]
    assert datagrams[-1].values[0] == pytest.approx(np.hypot(*moving[:2]), abs=0.05)
    assert datagrams[0].values == (0.0, 0.0, 0.0)


def test_truth_is_told_a_hundred_times_a_second(tmp_path: Path) -> None:
    scene = SimulatedScene(PAPER)
    scene.scan(0.0)
    writer = TumWriter(tmp_path / "truth.tum")

    async def tell() -> None:
        task = asyncio.create_task(feed_truth(scene, writer.tell))
        await asyncio.sleep(4.0)
        task.cancel()

    run_virtual(tell())
    writer.close()
    rows = np.loadtxt(tmp_path / "truth.tum")
    np.testing.assert_allclose(np.diff(rows[:, 0]), 0.01, atol=1e-6)
    want = scene.truth(rows[:, 0])
    np.testing.assert_allclose(rows[:, 1:3], want[:, :2], atol=1e-5)
    np.testing.assert_allclose(2 * np.arctan2(rows[:, 6], rows[:, 7]), want[:, 2], atol=1e-6)


def test_nobody_listening_stops_nobody() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    sender = UdpSender(f"udp://127.0.0.1:{port}")
    for _ in range(5):
        sender.tell(1.0, (1.0, 2.0, 3.0))
        time.sleep(0.002)
    sender.close()


def test_truth_datagram_is_one_json_object() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5.0)
        sender = UdpSender(f"udp://127.0.0.1:{listener.getsockname()[1]}")
        sender.tell(12.5, (1.0, -2.0, math.pi / 2))
        assert json.loads(listener.recv(500)) == {"t_mono": 12.5, "x": 1.0, "y": -2.0, "yaw": math.pi / 2}
        sender.close()


@pytest.mark.parametrize("text", ["127.0.0.1:5601", "udp://127.0.0.1", "udp://host:", "udp://host:0", "tcp://h:1"])
def test_a_bad_target_says_what_was_expected(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected udp://HOST:PORT"):
        udp_target(text)


def test_targets() -> None:
    assert udp_target("udp://127.0.0.1:5601") == ("127.0.0.1", 5601)
    assert udp_target("udp://[::1]:5601") == ("::1", 5601)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--pty", "/tmp/x", "--tcp", "127.0.0.1:0"], "give --pty or --tcp"),
        (["--tcp", "nonsense"], "expected HOST:PORT"),
        (["--odometry", "here"], "expected udp://HOST:PORT"),
        (["--faults", "/nonexistent/faults.toml"], "No such file"),
        (["--log", "/nonexistent/log.clf"], "/nonexistent/log.clf"),
        (["--log", "/nonexistent/log.clf", "--hold"], "a log goes on by its own clock"),
    ],
)
def test_bad_arguments_are_explained(words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "--seconds", "0.1"]) == 2
    assert complaint in capsys.readouterr().err


@pytest.mark.realtime
def test_the_process_streams_over_a_pty_and_leaves_nothing(tmp_path: Path) -> None:
    """Start it, read scans for a second as a host would, interrupt it."""
    link = tmp_path / "lidar"
    command = [sys.executable, "-m", "tools.sim", "--pty", str(link), "--truth", str(tmp_path / "truth.tum")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        hello = json.loads(process.stdout.readline())
        assert hello["lidar"] == str(link)
        port = os.open(link, os.O_RDWR | os.O_NOCTTY)
        time.sleep(0.1)
        os.write(port, b"MD0000072000000\n")
        begin, got = time.monotonic(), b""
        while time.monotonic() - begin < 1.0:
            if select.select([port], [], [], 0.2)[0]:
                got += os.read(port, 65536)
        os.close(port)
        assert got.count(b"MD0000072000000\n99b\n") > 10
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=10)
        assert process.returncode == 0
        assert json.loads(rest)["sent"] > 10
        assert not link.exists()
        assert len(np.loadtxt(tmp_path / "truth.tum")) > 10
    finally:
        process.kill()
        process.wait()
