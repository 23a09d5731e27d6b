"""Odometry datagrams in virtual time, and the process from outside."""

import asyncio
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hal.clock import run_virtual
from hal.net.input_codec import SHARED_CLOCK, InputDatagram, decode
from tools.sim.feed import feed_odometry
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
