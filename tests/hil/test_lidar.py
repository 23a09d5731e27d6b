"""A lidar that stands still: who it is, what it sees, how fast, when, how exactly."""

import asyncio

import numpy as np
import pytest

from hal.errors import DeviceMissing
from hal.hokuyo.models import UNKNOWN_MODEL, facts_of
from hal.lidar import VALID, Link, RawScan
from tests.hil.conftest import Telling
from tests.hil.ends import LidarEnd, asked, ended
from tools.bench.report.plots import Plot, Series, histogram

RATE_SHARE = 0.02
"""Motors are held to their nominal speed to a per cent or better (data sheets of URG, UTM, UST)."""
STAMP_S = 1e-3
BUSY = 4.0
"""In real time other programs delay arrivals, by which the sensor's clock is found: so much slack then."""
NOISE_M = 0.03
"""Repeatability of all models up to 10 m (data sheets: one sigma below 30 mm)."""
STILL_SIGMAS = 6.0
WRAP = 1 << 24


async def test_says_who_it_is(lidar: LidarEnd, told: Telling) -> None:
    """It says who it is, twice the same."""
    first = await lidar.identify()
    await asyncio.sleep(0.05)
    second = await lidar.identify()
    assert first.error is None, str(first)
    told.say(str(first))
    geometry = first.geometry
    assert geometry is not None
    assert geometry.serial
    assert geometry.firmware
    assert first.protocol.startswith("SCIP")
    assert (first.geometry, first.product) == (second.geometry, second.product)
    if facts_of(first.product, geometry.model) is UNKNOWN_MODEL:
        told.say("a model that is not known here: it is driven by what it says of itself")


async def test_scans_have_the_geometry_it_states(lidar: LidarEnd, told: Telling) -> None:
    """Scans have the beams it states, and ranges within its limits; it sees something."""
    scans = await lidar.measure(2.0)
    geometry = scans[0].geometry
    for scan in scans:
        beams = -(-(geometry.amax - geometry.amin + 1) // scan.stride)
        assert len(scan.ranges) == len(scan.code) == beams
        good = scan.ranges[scan.code == VALID]
        assert good.size == 0 or (good.min() >= geometry.dmin and good.max() <= geometry.dmax)
    last = scans[-1]
    bearings = np.degrees(geometry.bearings(last.first_step, last.stride, len(last.ranges)))
    assert 90.0 <= bearings[-1] - bearings[0] <= 360.0
    share = float(np.mean([np.mean(scan.code == VALID) for scan in scans]))
    told.figure("field of view", bearings[-1] - bearings[0], "deg", worse="less", share=0.001)
    told.figure("beams that measure", 100.0 * share, "%", worse="less", share=0.3)
    assert share > 0.2, "hardly a beam measures anything: is its window covered?"
    x, y = _points(last, np.radians(bearings))
    told.plot(Plot("last scan", "x m", "y m", (Series("", x.tolist(), y.tolist(), "dots"),), square=True))


def _points(scan: RawScan, bearing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r = scan.ranges[scan.code == VALID] * scan.geometry.range_unit_m
    at = bearing[scan.code == VALID]
    return r * np.cos(at), r * np.sin(at)


async def test_scans_come_at_the_rate_it_states(lidar: LidarEnd, told: Telling) -> None:
    """Scans come at the rate it states, none is lost."""
    driver = lidar.driver()
    scans = await lidar.measure(4.0, driver)
    geometry, status = scans[0].geometry, driver.status
    t = np.array([scan.t_mono for scan in scans])
    period = (t[-1] - t[0]) / (len(t) - 1)
    told.figure("rate", 1.0 / period, "Hz", worse="less", share=0.01)
    told.figure("scans lost", status.missed, worse="more", share=0.0, room=1.0)
    told.figure("frames damaged", status.invalid, worse="more", share=0.0, room=1.0)
    told.say(f"{len(scans)} scans, {status.dialect}, {status.reconnects} times opened anew")
    skipped = round(period / geometry.period_s)  # a slow line is asked for every second revolution, or fewer
    assert period == pytest.approx(skipped * geometry.period_s, rel=RATE_SHARE)
    assert status.missed <= 0.001 * len(scans) + (2 if lidar.real else 0)
    assert (status.invalid, status.reconnects) == (0, 0)


async def test_time_stamps(lidar: LidarEnd, told: Telling) -> None:
    """Times of scans follow the sensor's own clock within a millisecond and lie before their arrival."""
    scans = (await lidar.measure(5.0))[20:]
    t = np.array([scan.t_mono for scan in scans])
    tick = 1e-3 * np.unwrap(np.array([scan.t_tick for scan in scans], dtype=np.float64), period=WRAP)
    gain, offset = np.polyfit(tick - tick[0], t - t[0], 1)
    off = t - t[0] - (offset + gain * (tick - tick[0]))
    age = np.array([scan.t_rx - scan.t_mono for scan in scans])
    period = scans[0].geometry.period_s
    told.figure(
        "time stamps about the sensor's clock, rms", 1e3 * float(np.sqrt(np.mean(off**2))), "ms", worse="more", room=0.3
    )
    told.figure("age at arrival, median", 1e3 * float(np.median(age)), "ms", worse="more", room=2.0)
    told.figure("age at arrival, 99 %", 1e3 * float(np.quantile(age, 0.99)), "ms", worse="more", room=5.0)
    told.figure("sensor's clock is fast by", -1e6 * (gain - 1.0), "ppm")
    seconds = (t - t[0]).tolist()
    told.plot(Plot("time of scans about the sensor's clock", "s", "ms", (Series("", seconds, (1e3 * off).tolist()),)))
    told.plot(histogram("age at arrival", "ms", (1e3 * age).tolist()))
    assert (np.diff(t) > 0.0).all()
    assert np.sqrt(np.mean(off**2)) < STAMP_S * (BUSY if lidar.real else 1.0)
    assert abs(gain - 1.0) < 1000e-6, "the sensor's clock runs more than 1000 ppm wrong"
    assert (age > 0.0).all()
    assert np.median(age) < (3.0 if lidar.real else 1.5) * period


async def test_noise(lidar: LidarEnd, told: Telling) -> None:
    """Ranges of a sensor that stands still scatter as data sheets say."""
    scans = await lidar.measure(4.0)
    ranges = np.array([np.where(scan.code == VALID, scan.ranges, np.nan) for scan in scans]) * 1e-3
    steady = np.mean(np.isfinite(ranges), axis=0) > 0.9
    assert steady.sum() > 20, "hardly a beam measures again and again: is something in front of the sensor?"
    kept = ranges[:, steady]
    middle = np.nanmedian(kept, axis=0)
    sigma = 1.4826 * np.nanmedian(np.abs(kept - middle), axis=0)
    half = len(kept) // 2
    drift = np.abs(np.nanmedian(kept[:half], axis=0) - np.nanmedian(kept[half:], axis=0))
    spread = np.maximum(sigma, 1e-3) * np.sqrt(2.0 * np.pi / half)
    moved = float(np.mean(drift > STILL_SIGMAS * spread + 2e-3))
    told.figure("noise, median of beams", 1e3 * float(np.median(sigma)), "mm", worse="more", room=1.0)
    told.figure("noise, worst tenth of beams", 1e3 * float(np.quantile(sigma, 0.9)), "mm", worse="more", room=3.0)
    told.figure("beams that drop out", 100.0 * float(1.0 - np.mean(steady)), "%", worse="more", room=5.0)
    told.figure("correlation from scan to scan", _correlation(kept, middle), worse="more", room=0.2)
    told.plot(Plot("noise by range", "m", "mm", (Series("", middle.tolist(), (1e3 * sigma).tolist(), "dots"),)))
    assert moved < 0.1, f"{100 * moved:.0f} % of the beams drift: the sensor, or what it sees, does not stand still"
    assert np.median(sigma) < NOISE_M
    if lidar.fake is not None:
        assert np.median(sigma) == pytest.approx(8e-3, rel=0.2), "the fake's own noise is 8 mm"


def _correlation(kept: np.ndarray, middle: np.ndarray) -> float:
    off = np.nan_to_num(kept - middle)
    return float(np.sum(off[1:] * off[:-1]) / max(np.sum(off**2), 1e-12))


async def test_the_laser_is_off_when_the_driver_has_gone(lidar: LidarEnd, told: Telling) -> None:
    """Stopped and started three times; after each stop nothing comes out of the line."""
    counts = []
    for _ in range(3):
        counts.append(len(await lidar.measure(0.5)))
        port = await lidar.opener(lidar.device, lidar.place.baud or 115200)
        heard: list[int] = []
        port.start(lambda data, _t, heard=heard: heard.append(len(data)), lambda _error: None)  # type: ignore[misc]
        await asyncio.sleep(0.3)
        port.close()
        assert sum(heard) == 0, f"{sum(heard)} bytes in 0.3 s: it goes on measuring"
        await asyncio.sleep(0.05)
    told.say(f"{counts} scans")


@pytest.mark.needs("operator")
async def test_is_unplugged_and_plugged_in_again(lidar: LidarEnd, told: Telling) -> None:
    """Unplugged and plugged in again: said in words, and scans again by itself."""
    driver = lidar.driver()
    scans: list[RawScan] = []
    running = asyncio.create_task(driver.run(scans.append))
    try:
        await lidar.until(lambda: len(scans) > 10, 15.0, lambda: f"no scans: {driver.status.error}")
        await asked(lidar).ask("pull the lidar's cable", "order hangup where=lidar")
        gone = lambda: isinstance(driver.status.error, DeviceMissing) and driver.status.link is not Link.STREAMING  # noqa: E731  # asked again and again
        seconds = await lidar.until(gone, 15.0, lambda: f"nothing is said of it: {driver.status}")
        told.say(f"said {seconds:.2f} s after: {driver.status.error}")
        await asyncio.sleep(0.5)
        before = len(scans)
        await asked(lidar).ask("connect it again", "clear hangup lidar")
        back = await lidar.until(lambda: len(scans) > before, 30.0, lambda: f"no scan: {driver.status.error}")
        told.figure("scans again after", back, "s", worse="more", room=3.0)
        assert driver.status.reconnects >= 1
        assert [scan.seq for scan in scans] == sorted({scan.seq for scan in scans})
    finally:
        await ended(running)
