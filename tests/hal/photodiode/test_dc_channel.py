"""The DC channel: dark, dazzled and dead told apart; whatever happens to it, sampling goes on."""

import asyncio
import logging

import numpy as np
import pytest

from hal.adc import Blemish
from hal.photodiode.dc_channel import LevelInput
from hal.photodiode.driver import Sampling
from tests.hal.photodiode.bench import Bench, faked, on_fake

DC = Sampling(level=LevelInput(full_scale_v=3.0, rest_v=0.0))


def with_level(bench: Bench, volts: float = 1.2, chip: str = "ADS1115") -> None:
    bench.device.add_level(lambda t: np.full_like(t, volts / 3.3), chip=chip)


@pytest.mark.parametrize("chip", ["ADS1115", "ADS1015"])
@faked()
async def test_level_is_read_between_blocks(bench: Bench, chip: str) -> None:
    with_level(bench, chip=chip)
    driver = bench.driver(DC)
    async with bench.running(driver):
        blocks = await bench.more(60, 10.0, driver)
    assert driver.status.extra["dc_level"] == "40.0 %"
    assert not any(block.blemish for block in blocks)


@faked()
async def test_level_counts_from_rest(bench: Bench) -> None:
    """0.1 V is no light: the amplifier's bias."""
    with_level(bench, 1.7)
    driver = bench.driver(Sampling(level=LevelInput()))
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
    assert driver.status.extra["dc_level"] == "50.0 %"


@faked()
async def test_light_without_lamps_is_neither_dark_nor_dead(bench: Bench) -> None:
    """Daylight only: nothing flickers, the converter's own noise goes on."""
    noise = np.random.default_rng(4)
    bench.device._source = lambda t: 0.5 + 1.1e-4 * noise.standard_normal(t.size)
    with_level(bench)
    driver = bench.driver(DC)
    async with bench.running(driver):
        await bench.more(60, 10.0, driver)
        assert "there is light, but no modulated light" in str(driver.status.error)
        assert driver.status.recoveries == 0


@pytest.mark.parametrize("late", [0.0, 0.3, 0.6, 0.9])
@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("dark", "dark: no light reaches the photodiode .*cover"),
        ("saturated", "saturated: there is too much light for the amplifier .*shade"),
        ("stuck", "the converter or its input is defective .*wire"),
    ],
)
@faked()
async def test_causes_are_told_apart(bench: Bench, fault: str, says: str, late: float) -> None:
    with_level(bench)
    driver = bench.driver(DC)
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
        await asyncio.sleep(late)
        bench.order(f"what = '{fault}'")
        told: set[str] = set()
        for _ in range(300):
            await asyncio.sleep(0.01)
            told |= {str(driver.status.error)} if driver.status.error else set()
        assert len(told) == 1, told  # and never another cause first
        with pytest.raises(AssertionError, match=says):
            raise AssertionError(str(driver.status.error))
        bench.faults.clear()  # type: ignore[union-attr]  # there is one on a fake
        await asyncio.sleep(2.0)
        assert driver.status.error is None


@faked()
async def test_a_converter_that_is_dark_for_a_known_reason_is_left_alone(bench: Bench) -> None:
    with_level(bench)
    driver = bench.driver(DC)
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
        bench.order("what = 'dark'")
        await asyncio.sleep(100.0)
        assert driver.status.recoveries == 0
        assert driver.status.blocks > 1900


def test_a_dead_converter_is_started_afresh_now_and_then(caplog: pytest.LogCaptureFixture) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        async with bench.running(driver):
            await bench.more(30, 10.0, driver)
            bench.order("what = 'stuck'")
            await asyncio.sleep(100.0)
            assert 3 <= driver.status.recoveries <= 4
            assert "defective converter" in str(driver.status.error)

    with caplog.at_level(logging.INFO, "hal"):
        on_fake(body)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 1, told


@pytest.mark.parametrize(
    ("fault", "says"),
    [("what = 'dc_off'", "has no registers"), ("what = 'error'; name = 'EIO'; on = 'all'", None)],
)
@faked()
async def test_sampling_goes_on_without_it(bench: Bench, fault: str, says: str | None) -> None:
    with_level(bench)
    driver = bench.driver(DC)
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
        bench.order(fault)
        await asyncio.sleep(6.0)
        if says:
            assert says in driver.status.extra["dc_level"]
            assert driver.status.blocks > 140
        bench.faults.clear()  # type: ignore[union-attr]  # there is one on a fake
        await asyncio.sleep(10.0)
        assert driver.status.extra["dc_level"] == "40.0 %"


@faked()
async def test_a_brownout_of_the_dc_channel_is_no_darkness(bench: Bench) -> None:
    """After a reset it converts nothing and reads 0: its configuration is looked at before every reading."""
    with_level(bench)
    driver = bench.driver(DC)
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
        for _ in range(5):
            bench.order("what = 'brownout'")
            await asyncio.sleep(1.3)
            assert driver.status.extra["dc_level"] == "40.0 %"


@pytest.mark.parametrize("every_s", [0.02, 0.3, 1.1])
@pytest.mark.parametrize(
    ("chip", "config"),
    [("ADS1115", config) for config in (0x5283, 0x4283, 0x4383, 0xD3E3, 0x0000)] + [("ADS1015", 0x5283)],
)
def test_another_program_on_the_chip_is_noticed_and_its_input_is_no_level(
    chip: str, config: int, every_s: float, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it sets, the same input in the same range among it: no level, or the right one; one line in the log."""
    monkeypatch.setattr("hal.photodiode.dc_channel.CALM_S", 10.0)

    async def body(bench: Bench) -> None:
        with_level(bench, chip=chip)
        driver = bench.driver(DC)
        async with bench.running(driver):
            await bench.more(60, 10.0, driver)
            bench.order(f"what = 'foreign'; config = {config}; every_s = {every_s}")
            seen: set[str] = set()
            for _ in range(400):
                await asyncio.sleep(0.03)
                seen.add(driver.status.extra["dc_level"])
            assert not [said for said in seen if said.split()[0] not in ("40.0", "another")], seen
            assert any("another program changes the configuration of the" in said for said in seen)
            bench.faults.clear()  # type: ignore[union-attr]  # there is one on a fake
            await asyncio.sleep(15.0)
            assert driver.status.extra["dc_level"] == "40.0 %"
            assert not any(block.blemish for block in bench.blocks[60:] if block.blemish is not Blemish.GAP)

    with caplog.at_level(logging.INFO, "hal"):
        on_fake(body)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 1, told
    assert "another program changes the configuration of the" in told[0]


@pytest.mark.parametrize("wrong", ["LM75", "24C02"])
@faked()
async def test_another_chip_in_its_place(bench: Bench, wrong: str) -> None:
    bench.device.add_level(lambda t: np.full_like(t, 0.5), chip=wrong)
    driver = bench.driver(DC)
    async with bench.running(driver):
        await bench.more(30, 10.0, driver)
    assert "thresholds" in driver.status.extra["dc_level"]


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"chip": "MCP3221"}, "expected ADS1015 or ADS1115"),
        ({"address": 0x4D}, "0x48 to 0x4b"),
        ({"channel": 4}, "expected 0 to 3"),
        ({"full_scale_v": 0.0}, "expected up to"),
        ({"full_scale_v": 7.0}, "expected up to"),
        ({"rest_v": 3.3}, "at rest at 3.3 V"),
        ({"rest_v": -0.1}, "at rest"),
    ],
)
def test_an_input_that_cannot_be(fields: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        LevelInput(**fields)  # type: ignore[arg-type]  # keyword names vary
