"""A photodiode's converter: which it is, how fast it is read, what it says in the light and in the dark."""

import asyncio
from itertools import pairwise

import numpy as np
import pytest

from hal.adc import Blemish, ChipMissing, RawSamples
from hal.photodiode.probe import probe_bus
from tests.hil.conftest import Telling
from tests.hil.ends import AdcEnd, asked, ended
from tools.bench.report.plots import Plot, Series, histogram

DARK_WORDS = 3.0
"""One sigma of amplifier and converter in the dark: 0.45 words of the reference receiver, with room for another one."""
MAINS_HZ = (100.0, 120.0)


async def test_is_found(adc: AdcEnd, told: Telling) -> None:
    """The converter is at its address and of its kind."""
    finding = await probe_bus(adc.opener, adc.bus)
    told.say(str(finding))
    assert finding.error is None, str(finding.error)
    there = {chip.address: chip for chip in finding.chips}
    assert adc.address in there, f"nothing answers at {adc.address:#04x}; there are {sorted(map(hex, there))}"
    assert there[adc.address].usable, str(there[adc.address])
    assert adc.chip in there[adc.address].name, f"{there[adc.address]}, and not {adc.chip}"


async def test_blocks_and_rate(adc: AdcEnd, told: Telling) -> None:
    """Blocks follow each other without a hole, evenly spaced, words within the converter's bits."""
    blocks = await adc.measure(4.0)
    words = sum(block.words.size for block in blocks)
    span = blocks[-1].t1 - blocks[0].t0
    read = sum(block.t1 - block.t0 for block in blocks)
    blemished = [block for block in blocks[1:] if block.blemish]
    rates = np.array([block.rate_hz for block in blocks])
    told.figure("samples", rates[-1], "1/s", worse="less", share=0.02)
    told.figure("share of time that is sampled", 100.0 * read / span, "%", worse="less", share=0.02)
    told.figure("blocks with a blemish", 100.0 * len(blemished) / len(blocks), "%", worse="more", room=2.0)
    told.say(f"{len(blocks)} blocks, {words} words; blemishes: {sorted({str(block.blemish) for block in blemished})}")
    told.plot(Plot("samples a second", "block", "1/s", (Series("", [*range(len(rates))], rates.tolist()),)))
    assert [block.seq for block in blocks] == [*range(blocks[0].seq, blocks[0].seq + len(blocks))]
    assert max(block.words.max() for block in blocks) < 1 << blocks[0].bits
    assert all(late.t0 >= early.t1 for early, late in pairwise(blocks))
    assert rates[-1] > 5000.0, "too slow for lamps: SCL should be 400 kHz"
    assert not any(block.blemish & (Blemish.MISALIGNED | Blemish.SHORT) for block in blocks)
    assert len(blemished) <= (0.1 if adc.real else 0.0) * len(blocks)


@pytest.mark.needs("light")
async def test_light_levels(adc: AdcEnd, told: Telling) -> None:
    """In the light: the signal swings well above the converter's own noise, and touches neither rail."""
    blocks = await adc.measure(3.0)
    swing, clipped = _swing(blocks), np.mean([_rails(block) for block in blocks])
    frequency, power = _spectrum(blocks)
    told.figure("swing of the signal", swing, "words rms", worse="less", share=0.5)
    told.figure("samples at a rail", 100.0 * float(clipped), "%", worse="more", room=0.1)
    for mains in MAINS_HZ:
        told.figure(f"{mains:.0f} Hz above its surroundings", _above(frequency, power, mains), "dB")
    told.plot(Plot("spectrum", "Hz", "dB", (Series("", frequency.tolist(), power.tolist()),)))
    told.plot(histogram("words", "word", blocks[-1].words.astype(float).tolist()))
    assert swing > 5.0, "hardly more than noise: is there light, and is the photodiode connected?"
    assert clipped < 0.01, "the amplifier is at its limit: less gain, or a smaller photodiode"


@pytest.mark.needs("light", "operator")
async def test_in_the_dark(adc: AdcEnd, told: Telling) -> None:
    """Covered: nothing is left but the electronics' own noise; uncovered, the light is back."""
    lit = _swing(await adc.measure(1.0))
    await asked(adc).ask("cover the photodiode so that no light reaches it", "order dark where=adc")
    dark_blocks = await adc.measure(2.0)
    dark = _swing(dark_blocks)
    frequency, power = _spectrum(dark_blocks)
    told.figure("noise in the dark", dark, "words rms", worse="more", room=0.3)
    told.figure("light above dark", 20.0 * np.log10(lit / max(dark, 1e-3)), "dB", worse="less", share=0.2)
    told.plot(Plot("spectrum in the dark", "Hz", "dB", (Series("", frequency.tolist(), power.tolist()),)))
    await asked(adc).ask("uncover it", "clear dark adc")
    assert dark < DARK_WORDS, "noise in the dark: look at ground, shielding and supply"
    assert lit > 4.0 * dark
    assert _swing(await adc.measure(1.0)) > 0.5 * lit


@pytest.mark.needs("operator")
async def test_is_unplugged_and_plugged_in_again(adc: AdcEnd, told: Telling) -> None:
    """The receiver's cable pulled and put back: said in words, and samples again by itself."""
    driver = adc.driver()
    blocks: list[RawSamples] = []
    running = asyncio.create_task(driver.run(blocks.append))
    try:
        await adc.until(lambda: len(blocks) > 3, 15.0, lambda: f"no samples: {driver.status.error}")
        await asked(adc).ask("pull the receiver's cable from the bus", "order off where=adc")
        gone = lambda: isinstance(driver.status.error, ChipMissing)  # noqa: E731  # asked again and again
        seconds = await adc.until(gone, 15.0, lambda: f"nothing is said of it: {driver.status}")
        told.say(f"said {seconds:.2f} s after: {driver.status.error}")
        before = len(blocks)
        await asked(adc).ask("connect it again", "clear off adc")
        back = await adc.until(lambda: len(blocks) > before + 2, 40.0, lambda: f"no samples: {driver.status.error}")
        told.figure("samples again after", back, "s", worse="more", room=3.0)
    finally:
        await ended(running)


def _swing(blocks: list[RawSamples]) -> float:
    """One sigma of the words, of the block in the middle of all."""
    return float(np.median([block.words.astype(np.float64).std() for block in blocks[1:]]))


def _rails(block: RawSamples) -> float:
    top = (1 << block.bits) - 1
    return float(np.mean((block.words == 0) | (block.words == top)))


def _spectrum(blocks: list[RawSamples]) -> tuple[np.ndarray, np.ndarray]:
    """Mean power by frequency in dB of a word squared."""
    size = min(block.words.size for block in blocks)
    window = np.hanning(size)
    rows = [np.abs(np.fft.rfft((block.words[:size] - block.words[:size].mean()) * window)) ** 2 for block in blocks]
    power = 10.0 * np.log10(np.mean(rows, axis=0) / np.sum(window**2) + 1e-9)
    return np.fft.rfftfreq(size, 1.0 / blocks[-1].rate_hz), power


def _above(frequency: np.ndarray, power: np.ndarray, wanted: float) -> float:
    """How far a line stands above the median of what surrounds it, dB."""
    near = np.abs(frequency - wanted)
    around = power[(near > 60.0) & (near < 800.0)]
    return float(power[near < 25.0].max() - np.median(around))
