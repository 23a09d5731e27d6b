"""The driver starts from any state a sensor can be in. Bodies without faults run on a real sensor too (--lidar)."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from hal.errors import DeviceRefused
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import MODELS, UST_10LX, UTM_30LX, LidarModel, Unit
from hal.lidar import VALID, Link
from hal.port.port import Port
from tests.hal.hokuyo.bench import Bench, faked, on_bench, on_fake

BY_HAND = {
    "idle": (),
    "single": (b"BM\n",),
    "streaming": (b"MD0100020001000\n",),
    "streaming, every step": (b"MD0000072001000\n",),
    "streaming, counted": (b"MD0100020001099\n",),
    "time adjustment": (b"TM0\n",),
    "half a command": (b"MD0100",),
    "another program's words": (b"AT\r", b"ATE1 E0\r", b"AT+CGMI\r"),
    "streaming, then half a command": (b"MD0100020001000\n", b"VV\nPP\nQ"),
}
"""States a sensor can be put into from outside, with what brings it there."""


@pytest.fixture
def lidar(request: pytest.FixtureRequest) -> str:
    return str(request.config.getoption("--lidar") or "fake")


@pytest.mark.parametrize("words", BY_HAND.values(), ids=BY_HAND)
@pytest.mark.parametrize("model", [UTM_30LX, UST_10LX], ids=["2.0", "2.2"])
def test_from_any_state(words: tuple[bytes, ...], model: LidarModel, lidar: str) -> None:
    if lidar != "fake" and model is UST_10LX:
        pytest.skip("a real sensor speaks the one dialect it has")

    async def body(bench: Bench) -> None:
        await bench.say(*words)
        driver = bench.driver()
        scans = await bench.deliver(driver, 30, within=2.5 if bench.fake else 10.0)
        geometry = driver.geometry
        assert geometry is not None
        assert [scan.seq for scan in scans] == list(range(30))
        for scan in scans:
            assert scan.geometry == geometry
            assert scan.first_step == geometry.amin
            assert len(scan.ranges) == len(scan.code) == geometry.amax - geometry.amin + 1
            assert (scan.ranges[scan.code == VALID] >= geometry.dmin).all()
            assert (scan.ranges[scan.code != VALID] == 0).all()
            assert scan.t_mono < scan.t_rx
        steps = np.diff([scan.t_mono for scan in scans])
        assert np.allclose(steps[5:], geometry.period_s, rtol=0.05)
        status = driver.status
        assert (status.link, status.error, status.invalid, status.reconnects) == (Link.CLOSED, None, 0, 0)
        if bench.fake is not None:
            assert bench.fake.state is State.IDLE  # the laser is off after the driver has gone

    on_bench(body, lidar, model)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_every_model_gives_every_scan_at_its_time(model: LidarModel) -> None:
    """True beam times are known on the bench: stamps are cut to whole ms, yet times are right to a fraction."""

    if model is MODELS["UBG-04LX-F01"]:  # 750 kbit/s is a little short of what it measures
        model = replace(model, link="usb")
    rs232 = model.link == "rs232"

    async def body(bench: Bench) -> None:
        assert bench.scene is not None
        driver = bench.driver(baud=750000 if rs232 else 0)
        scans = await bench.deliver(driver, 200, within=40.0)
        assert driver.status.missed == 0
        expected = bench.scene(0.0).ranges_mm[model.amin + 2 :].copy()
        valid = (expected >= model.dmin) & (expected <= model.dmax)
        errors = []
        for scan in scans:
            assert (scan.ranges[2:] == np.where(valid, expected, 0)).all()
            assert (scan.code[2:] == np.where(valid, VALID, expected)).all()
            first_beam = bench.scene.start_of(scan) + model.amin * model.true_period_s / model.ares
            errors.append(scan.t_mono - first_beam)
        assert np.abs(errors).max() < 1e-3
        assert np.sqrt(np.mean(np.square(errors[20:]))) < 3e-4
        assert np.mean(np.abs(errors[20:]) < 2 * scans[-1].t_sigma) > 0.9

    on_fake(body, model, Unit(clock_gain=50e-6), device="/dev/ttyUSB7" if rs232 else "/dev/fake7")


@pytest.mark.parametrize("model", [UTM_30LX, UST_10LX], ids=["2.0", "2.2"])
@pytest.mark.parametrize("state", ["booting", "error", "scip1", "sleep"])
def test_from_states_only_a_fault_can_make(state: str, model: LidarModel) -> None:
    async def body(bench: Bench) -> None:
        assert bench.fake is not None
        if state == "error":
            await bench.say(b"MD0100020001000\n")
            bench.order('[[fault]]\nwhat = "error"')
        elif state == "scip1":
            bench.order('[[fault]]\nwhat = "scip1"')
        elif state == "sleep":
            await bench.say(b"%SL\n")
        await asyncio.sleep(0.01)
        driver = bench.driver()
        scans = await bench.deliver(driver, 30, within=20.0)
        assert scans[-1].ranges[5] > 0
        assert bench.fake.state is State.IDLE

    on_fake(body, model, Unit(booted=state != "booting", spin_up_s=3.0 if state == "booting" else 0.0))


@pytest.mark.parametrize("rate", [19200, 57600, 115200, 250000, 500000, 750000])
def test_rs232_from_any_rate(rate: int) -> None:
    """A URG-04LX needs 250 kbit/s for every scan; it is found at any rate and brought there."""

    async def body(bench: Bench) -> None:
        assert bench.fake is not None
        driver = bench.driver()
        scans = await bench.deliver(driver, 30, within=30.0)
        assert bench.fake.baud == max(rate, 250000)
        assert driver.status.extra["baud"] == str(bench.fake.baud)
        assert driver.status.missed == 0
        assert len(scans[0].ranges) == 682
        assert driver.status.dialect == "SCIP 2.0 MD"

    on_fake(body, MODELS["URG-04LX"], Unit(baud=rate), device="/dev/ttyUSB7")


@faked(MODELS["URG-04LX"], Unit(baud=115200), device="/dev/ttyUSB7")
async def test_rs232_still_streaming_at_a_slow_rate(bench: Bench) -> None:
    await bench.say(b"MD0044072501000\n", pause=3.0)
    await bench.deliver(bench.driver(), 10, within=30.0)


@pytest.mark.parametrize(("baud", "beams", "period"), [(115200, 341, 0.1002), (57600, 227, 0.2004), (19200, 227, 0.4)])
@faked(MODELS["URG-04LX"], device="/dev/ttyUSB7")
async def test_a_slow_line_gets_what_it_can_carry(bench: Bench, baud: int, beams: int, period: float) -> None:
    driver = bench.driver(baud=baud)
    scans = await bench.deliver(driver, 20, within=40.0)
    assert len(scans[0].ranges) == beams
    assert driver.status.missed == 0
    assert np.allclose(np.diff([scan.t_mono for scan in scans[5:]]), period, rtol=0.01)
    assert bench.fake is not None
    assert bench.fake.counts.lost_in_sensor == 0


@faked(MODELS["URG-04LX"], device="/dev/ttyUSB7")
async def test_an_adapter_that_cannot_do_the_rate_wanted(bench: Bench) -> None:
    """The next lower rate both sides can do, and clusters that fit it."""
    real = bench.opener

    async def opener(device: str, baud: int) -> Port:
        port = await real(device, baud)
        plain = port.set_baud

        def limited(rate: int) -> None:
            if rate > 115200:
                raise DeviceRefused(device, f"cannot do {rate} bit/s", "choose another line rate")
            plain(rate)

        port.set_baud = limited  # type: ignore[method-assign]  # an adapter with limits
        return port

    bench.opener = opener
    driver = bench.driver()
    scans = await bench.deliver(driver, 20, within=20.0)
    assert driver.status.extra["baud"] == "115200"
    assert len(scans[0].ranges) == 341
    assert driver.status.missed == 0


@faked(MODELS["URG-04LX"], device="/dev/ttyUSB7")
async def test_a_rate_at_which_the_sensor_is_lost_is_not_tried_again(bench: Bench) -> None:
    """The cable is too bad for 250 kbit/s: the sensor accepts and cannot be understood there."""
    assert bench.fake is not None
    fake, tries = bench.fake, 0
    send = fake.receive

    def receive(data: bytes) -> None:
        nonlocal tries
        if b"SS250000" in data:
            tries += 1
        if fake.baud == 250000:
            if b"QT" not in data:
                return
            data = b"RS\n" + data  # stands for a person who power-cycles it
        send(data)

    fake.receive = receive  # type: ignore[method-assign]  # a bad cable
    driver = bench.driver()
    await bench.deliver(driver, 20, within=60.0)
    assert tries == 1
    assert driver.status.extra["baud"] == "115200"
