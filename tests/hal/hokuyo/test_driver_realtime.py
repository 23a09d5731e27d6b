"""The driver over a kernel pty and a loopback socket, against the wall clock with fourfold slack."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from hal.clock import SystemClock
from hal.errors import DeviceMissing
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import UST_10LX, UTM_30LX, LidarModel
from hal.fake.transport.pty_server import PtyServer
from hal.fake.transport.tcp_server import TcpServer
from hal.hokuyo.passive import PassiveHokuyo
from hal.hokuyo.payload import ScanRequest, parse_scan
from hal.hokuyo.scip import FrameSplitter, parse_reply
from hal.port.opening import open_port
from tests.hal.hokuyo import encoder
from tests.hal.hokuyo.bench import Bench, Scene, error_of

pytestmark = pytest.mark.realtime

SLACK = 4.0


def bench_at(model: LidarModel, device: str, fake: FakeHokuyo, scene: Scene) -> Bench:
    assert model is fake.model
    faults = FaultSchedule({"lidar": fake})
    return Bench(SystemClock(), open_port, device, fake, scene, None, faults)


async def judged(bench: Bench, again: Callable[[], Awaitable[None]] | None = None) -> None:
    """Stream, compare with the truth, lose the sensor, get it back, leave."""
    assert bench.fake is not None
    assert bench.scene is not None
    model = bench.fake.model
    driver = bench.driver()
    async with bench.running(driver):
        scans = await bench.more(80, SLACK * 3.0, driver)
        assert [scan.seq for scan in scans] == list(range(80))
        truth = bench.scene._base[2:]
        valid = (truth >= model.dmin) & (truth <= model.dmax)
        for scan in scans:
            assert (scan.ranges[2:] == np.where(valid, truth, 0)).all()
        errors = [scan.t_mono - bench.scene.start_of(scan) for scan in scans[40:]]
        assert np.median(np.abs(errors)) < SLACK * 1e-3
        bench.order('[[fault]]\nwhat = "hangup"\nfor = 0.4')
        await asyncio.sleep(0.2)
        assert isinstance(error_of(driver), DeviceMissing)  # noticed at once, not after a time-out
        await bench.more(20, SLACK * 3.0, driver)
        assert driver.status.error is None
        assert driver.status.reconnects == 1
        assert driver.status.invalid == 0
        began = time.monotonic()
    assert time.monotonic() - began < SLACK * 0.1
    await asyncio.sleep(0.1)
    assert bench.fake.state is State.IDLE


async def test_over_a_pty(tmp_path: Path) -> None:
    scene = Scene(UTM_30LX)
    fake = FakeHokuyo(UTM_30LX, scene)
    server = PtyServer(fake, tmp_path / "lidar")
    bench = bench_at(UTM_30LX, str(tmp_path / "lidar"), fake, scene)
    await bench.say(b"MD0100020001000\n")  # left streaming by somebody else
    await judged(bench)
    assert bench.faults is not None
    bench.faults.close()
    server.close()
    fake.close()


async def test_over_tcp() -> None:
    scene = Scene(UST_10LX)
    fake = FakeHokuyo(UST_10LX, scene)
    server = TcpServer(fake)
    number = await server.listen()
    bench = bench_at(UST_10LX, f"tcp://127.0.0.1:{number}", fake, scene)
    await judged(bench)
    assert bench.faults is not None
    bench.faults.close()
    await server.close()
    fake.close()


@pytest.mark.parametrize(("name", "budget_us"), [("MD", 150.0), ("ME", 250.0)])
def test_cost_of_a_frame(name: str, budget_us: float) -> None:
    """From 128-byte pieces of the wire to a timed scan of 1081 beams, median."""
    request = ScanRequest(name, 0, 1080)
    rng = np.random.default_rng(0)
    steps = rng.integers(0, 30000, (1081, 2 if name == "ME" else 1)).tolist()
    wire = [
        encoder.scan(request.echo.decode(), 1000 + 25 * k, encoder.payload([[tuple(s)] for s in steps]))
        for k in range(200)
    ]
    splitter = FrameSplitter()
    listener = PassiveHokuyo()
    listener.feed(encoder.text("VV", encoder.VV_UTM) + encoder.text("PP", encoder.PP_UTM), 0.0)
    decode, whole = [], []
    for k, frame in enumerate(wire):
        t0 = time.perf_counter()
        (cut,) = splitter.feed(frame)
        parse_scan(request, parse_reply(cut))
        t1 = time.perf_counter()
        for at in range(0, len(frame), 512):
            scans = listener.feed(frame[at : at + 512], 1.0 + 0.025 * k)
        t2 = time.perf_counter()
        assert len(scans) == 1
        decode.append(1e6 * (t1 - t0))
        whole.append(1e6 * (t2 - t1))
    assert np.median(decode) < SLACK * budget_us
    assert np.median(whole) < SLACK * 2 * budget_us
