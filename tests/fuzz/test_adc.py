"""Words, registers, frames and whole storms of faults at random: nothing may break, and nothing untrue may come out."""

import asyncio
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.adc import Blemish
from hal.bus import i2c_frames as frames
from hal.bus.i2c import MAX_LENGTH, Message
from hal.fake.adc.faults import ADC
from hal.fake.adc.i2c_adapters import BCM2835, DESIGNWARE
from hal.lidar import Link
from hal.photodiode import adc121c021, ads1x15, mcp3221
from hal.photodiode.block_check import inspect
from hal.photodiode.timebase import SclClock
from tests.hal.photodiode.bench import Bench, falsehoods, on_fake


@given(data=st.binary(max_size=400), extra=st.integers(0, 100))
def test_any_bytes_make_words_or_none(data: bytes, extra: int) -> None:
    words, blemish, defects = inspect(data, len(data) + extra, 0xF000, 12)
    raw = [int.from_bytes(data[k : k + 2], "big") for k in range(0, len(data) // 2 * 2, 2)]
    damaged = [bool(word & 0xF000) for word in raw[: words.size]]
    assert defects.repaired == (sum(damaged) if Blemish.REPAIRED in blemish else 0)
    assert all(a == b & 0xFFF or (hit and defects.repaired) for a, b, hit in zip(words, raw, damaged, strict=False))
    assert (Blemish.SHORT in blemish) == (words.size < (len(data) + extra) // 2)
    assert (blemish & (Blemish.MISALIGNED | Blemish.REPAIRED) != Blemish.NONE) == (any(damaged) or defects.lost_bits)
    assert all(word == 0xFFFF for word in raw[words.size :])
    assert 0.0 <= defects.clipped <= 1.0
    assert 0.0 <= defects.misaligned <= 1.0
    if blemish == Blemish.NONE and words.size:
        assert 0 < words.min() <= words.max() < 4095


@given(answers=st.lists(st.one_of(st.none(), st.binary(max_size=3)), min_size=4, max_size=4))
def test_any_answers_are_judged(answers: list[bytes | None]) -> None:
    assert isinstance(mcp3221.mismatch((answers[0],)), str)
    assert isinstance(adc121c021.mismatch(tuple(answers)), str)
    assert isinstance(ads1x15.mismatch((answers[0], answers[1])), str)
    assert isinstance(ads1x15.same_configuration(answers[2] or b"", ads1x15.Configuration()), bool)


@given(
    spans=st.lists(st.floats(0.0, 5.0), min_size=1, max_size=300),
    length=st.integers(60, MAX_LENGTH),
    spread=st.floats(0.0, 0.1),
)
def test_any_durations_are_timed(spans: list[float], length: int, spread: float) -> None:
    scl = SclClock(length, (10 + 9 * length) / 400e3 + 1e-4, 28 / 400e3 + 1e-4, spread)
    for k, span in enumerate(spans):
        timing = scl.add(10.0 * k, 10.0 * k + span)
        assert np.isfinite([timing.t_first, timing.slack_s, timing.rate_hz]).all()
        assert timing.slack_s >= 0.0
        assert timing.rate_hz > 0.0
        assert timing.t_first > 10.0 * k


messages = st.lists(
    st.one_of(
        st.builds(lambda a, d: Message(a, d), st.integers(0, 127), st.binary(min_size=1, max_size=50)),
        st.builds(lambda a, n: Message(a, length=n), st.integers(0, 127), st.integers(1, MAX_LENGTH)),
    ),
    min_size=1,
    max_size=42,
)


@given(number=st.integers(0, 2**32 - 1), sent=messages)
def test_transfers_survive_the_wire(number: int, sent: list[Message]) -> None:
    ((kind, body),) = frames.Splitter().feed(frames.transfer(number, tuple(sent)))
    assert kind == frames.TRANSFER
    assert frames.parse_transfer(body) == (number, tuple(sent))


TRACELESS = {"wrong", "clip"}
"""They make other words of the light's without any trace; every other fault has to be seen or survived."""
PASSING = {"late", "busy", "delayed"}
"""If every long read took the same time too long, and no short one, that would be how this adapter is."""


def orders(chance: random.Random, count: int) -> list[str]:
    """Random faults, each for a second or two, one on top of the other."""
    found = []
    for _ in range(count):
        what = chance.choice(sorted(set(ADC) - TRACELESS - {"dc_off", "foreign"}))
        order = f"what = '{what}'; when = {chance.uniform(0.0, 30.0):.3f}"
        if ADC[what].kind != "once":
            order += f"; for = {chance.uniform(0.05, 2.0):.3f}"
        if ADC[what].kind == "strikes":
            order += f"; share = {0.2 if what in PASSING else chance.choice((0.1, 0.5, 1.0))}"
        if what == "shift":
            order += "; bits = 4"  # one bit makes other legal words of those below half scale: nothing can show that
        found.append(order)
    return found


@pytest.mark.parametrize("seed", range(8))
def test_storms(seed: int) -> None:
    async def body(bench: Bench) -> None:
        chance = random.Random(seed)
        driver = bench.driver()
        async with bench.running(driver):
            await bench.more(5, 10.0, driver)
            for order in orders(chance, 15):
                bench.order(order)
            await asyncio.sleep(50.0)
            assert driver.status.link is Link.STREAMING, driver.status
            assert driver.status.error is None
            calm = bench.clock.now()
            blocks = await bench.more(20, 3.0, driver)
            assert all(block.blemish == Blemish.NONE for block in blocks if block.t0 > calm)
        assert [block.seq for block in bench.blocks] == sorted({block.seq for block in bench.blocks})
        assert falsehoods(bench, bench.blocks, rate_error=0.02) == []

    on_fake(body, adapter=BCM2835 if seed % 2 else DESIGNWARE, seed=seed)
