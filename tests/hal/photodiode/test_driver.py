"""The driver's conduct while nothing is wrong; the first tests also run on a real converter (``--adc``)."""

import asyncio
from itertools import pairwise

import numpy as np
import pytest

from hal.adc import Blemish
from hal.bus.i2c import AsyncBus
from hal.fake.adc.i2c_adapters import BCM2835, CH341, CP2112, DESIGNWARE, FT260, I2C_GPIO, Adapter
from hal.lidar import Link
from hal.photodiode.driver import PhotodiodeAdc, Sampling
from tests.hal.photodiode.bench import Bench, faked, falsehoods, on_bench, on_fake


@pytest.fixture
def adc(request: pytest.FixtureRequest) -> str:
    return str(request.config.getoption("--adc") or "fake")


def test_delivers_uniform_blocks(adc: str) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        async with bench.running(driver):
            blocks = await bench.more(20, 10.0, driver)
            assert driver.status.link is Link.STREAMING
            assert driver.status.error is None
        assert driver.status.link is Link.CLOSED
        assert [block.seq for block in blocks] == list(range(20))
        for block in blocks:
            assert block.words.dtype == np.uint16
            assert block.words.max() < 1 << block.bits
            assert block.t0 < block.t_first < block.t1
            assert 0.02 < block.words.size / block.rate_hz < 0.06
        assert all(late.t0 >= early.t1 for early, late in pairwise(blocks))

    on_bench(body, adc)


def test_can_be_stopped_and_started_again(adc: str) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        for _ in range(2):
            async with bench.running(driver):
                await bench.more(3, 10.0, driver)
        assert [block.seq for block in bench.blocks] == sorted({block.seq for block in bench.blocks})

    on_bench(body, adc)


@pytest.mark.parametrize("adapter", [BCM2835, DESIGNWARE], ids=lambda a: a.name.split()[0])
@pytest.mark.parametrize(("chip", "address"), [("MCP3221", 0x4D), ("ADC121C021", 0x54)])
def test_words_and_times_are_the_converters_own(chip: str, address: int, adapter: Adapter) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        async with bench.running(driver):
            await bench.more(100, 10.0, driver)
        assert not any(block.blemish for block in bench.blocks)
        assert falsehoods(bench, bench.blocks) == []

    on_fake(body, chip, address, adapter)


@pytest.mark.parametrize("percent", [-1.0, 1.0, -37.0])
@faked()
async def test_scl_is_measured(bench: Bench, percent: float) -> None:
    bench.device.bus.scl_error = 0.01 * percent
    driver = bench.driver()
    async with bench.running(driver):
        blocks = await bench.more(300, 40.0, driver)
    true_hz = 400e3 * (1.0 + 0.01 * percent) / 18
    assert abs(blocks[0].rate_hz / true_hz - 1.0) < 500e-6
    assert abs(blocks[-1].rate_hz / true_hz - 1.0) < 100e-6
    assert abs(blocks[-1].words.size / true_hz - 0.05) < 1e-3
    assert driver.status.extra["scl"] == f"{18e-3 * blocks[-20].rate_hz:.2f} kHz"


@faked()
async def test_blocks_are_read_back_to_back(bench: Bench) -> None:
    driver = bench.driver()
    async with bench.running(driver):
        blocks = await bench.more(50, 10.0, driver)
    pauses = [late.t0 - early.t1 for early, late in pairwise(blocks)]
    assert max(pauses) < 1e-3


@faked()
async def test_first_word_after_a_pause_is_left_out(bench: Bench) -> None:
    """It was sampled when the transaction before the pause ended."""
    driver = bench.driver()
    async with bench.running(driver):
        before = await bench.more(3, 10.0, driver)
        bench.order("what = 'nack'; count = 4")  # three retries do not help: reopened a second later
        after = await bench.more(5, 10.0, driver)
    returned = [block for block in after if block.blemish]
    assert [block.blemish for block in returned] == [Blemish.GAP]
    assert returned[0].t0 - before[-1].t1 > 0.8
    assert before[0].words.size == returned[0].words.size == before[1].words.size - 1
    assert falsehoods(bench, bench.blocks) == []


@pytest.mark.parametrize(
    ("adapter", "samples", "why"),
    [
        (FT260, 30, "60 bytes"),
        (CP2112, 30, "61 bytes"),
        (CH341, 30, "32 bytes"),
        (I2C_GPIO, 278, "the processor clocks this bus in software, with"),
    ],
    ids=["FT260", "CP2112", "CH341", "i2c-gpio"],
)
def test_adapters_that_pause_are_named(
    adapter: Adapter, samples: int, why: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        async with bench.running(driver):
            blocks = await bench.more(5, 10.0, driver)
        assert why in driver.status.extra["limit"]
        assert abs(blocks[-1].words.size - samples) <= 4

    on_fake(body, adapter=adapter)
    assert [
        why in one.getMessage()
        for one in caplog.records
        if "samples cannot be used to decode lamps" in one.getMessage()
    ] == [True]


def test_nothing_is_said_of_an_adapter_that_does_not_pause(caplog: pytest.LogCaptureFixture) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        async with bench.running(driver):
            await bench.more(5, 10.0, driver)

    on_fake(body)
    assert not caplog.records


@faked(adapter=Adapter("SMBus thing", max_read=32))
async def test_an_adapter_that_cannot_read_blocks_is_refused(bench: Bench) -> None:
    driver = bench.driver()
    async with bench.running(driver):
        await asyncio.sleep(3.0)
        assert "cannot read 60 bytes at once" in str(driver.status.error)
    assert not bench.blocks


@faked()
async def test_block_length_follows_the_wish(bench: Bench) -> None:
    driver = bench.driver(Sampling(block_s=0.03))
    async with bench.running(driver):
        blocks = await bench.more(5, 10.0, driver)
    assert abs(blocks[-1].words.size / blocks[-1].rate_hz - 0.03) < 1e-3


@faked(adapter=Adapter("fast", scl_hz=1e6))
async def test_scl_beyond_the_data_sheet_is_told(bench: Bench) -> None:
    driver = bench.driver()
    async with bench.running(driver):
        await bench.more(5, 10.0, driver)
    assert "faster than the 400 kHz" in driver.status.extra["warning"]


@pytest.mark.parametrize(
    ("chip", "address", "block_s", "says"),
    [
        ("MCP3421", 0x68, 0.05, "supported are mcp3221"),
        ("ADS1115", 0x48, 0.05, "levels only"),
        ("MCP3221", 0x54, 0.05, "has one of the addresses 0x48, 0x49"),
        ("ADC121C021", 0x4D, 0.05, "has one of the addresses 0x50"),
        ("mcp3221", 0x4D, 0.0, "0.001 to 1 s"),
        ("mcp3221", 0x4D, float("nan"), "0.001 to 1 s"),
    ],
)
@faked()
async def test_what_cannot_be_is_refused_at_once(
    bench: Bench, chip: str, address: int, block_s: float, says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        PhotodiodeAdc("/dev/i2c-1", address, chip, clock=bench.clock, opener=bench.opener, sampling=Sampling(block_s))


@faked()
async def test_an_open_that_hangs_is_told(bench: Bench) -> None:
    real, opened = bench.opener, 0

    async def opener(name: str) -> AsyncBus:
        nonlocal opened
        opened += 1
        await asyncio.sleep(20.0)
        return await real(name)

    bench.opener = opener
    driver = bench.driver()
    async with bench.running(driver):
        await asyncio.sleep(3.1)
        assert "opening the bus has taken 3 s" in str(driver.status.error)
        assert driver.status.link is Link.WAITING
        await bench.more(3, 20.0, driver)
        assert driver.status.error is None
        assert opened == 1


@faked()
async def test_stopping_during_an_open_that_hangs(bench: Bench) -> None:
    ended = asyncio.Event()

    async def opener(_name: str) -> AsyncBus:
        try:
            await asyncio.sleep(1e6)
        finally:
            ended.set()
        raise AssertionError

    bench.opener = opener
    for seconds in (1.0, 10.0):
        ended.clear()
        async with bench.running(bench.driver()):
            await asyncio.sleep(seconds)
        await asyncio.sleep(0.0)
        assert ended.is_set()


@pytest.mark.parametrize("words", [1, 10])
@faked()
async def test_a_damaged_word_costs_that_word_and_not_the_block(bench: Bench, words: int) -> None:
    driver = bench.driver()
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
        bench.order(f"what = 'hit'; words = {words}; mask = 0xf800")
        blocks = (await bench.more(42, 10.0, driver))[2:]
        assert driver.status.error is None
    times = bench.light.asked[-1]
    codes = np.floor(4096.0 * bench.light.at(times))
    assert all(block.blemish is Blemish.REPAIRED for block in blocks)
    off = np.abs(blocks[-1].words.astype(float) - codes)
    assert 0 < np.count_nonzero(off) <= words
    assert off.max() < 0.05 * 4096


@pytest.mark.parametrize("bits", [1, 2, 3, 4])
@faked()
async def test_lost_clocks_are_told_where_the_light_is_low(bench: Bench, bits: int) -> None:
    bright = bench.device._source
    bench.device._source = lambda t: 0.01 + 0.03 * bright(t)
    driver = bench.driver()
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
        bench.order(f"what = 'shift'; bits = {bits}")
        seen: set[str] = set()
        for _ in range(100):
            await asyncio.sleep(0.01)
            seen.add(str(driver.status.error))
        assert any("words without their highest bits (check converter type" in said for said in seen)
        bench.faults.clear()  # type: ignore[union-attr]  # there is one on a fake
        await bench.more(20, 10.0, driver)
        assert driver.status.error is None
