"""The fake's chips, byte for byte by their data sheets."""

import numpy as np
import pytest

from hal.fake.adc.chips import Adc121c021, Ads1x15, Lm75, Mcp3221
from hal.fake.adc.i2c_timing import SclTiming

LINE = SclTiming(10.0, 400e3)


def constant(value: float) -> object:
    return lambda t: np.full_like(t, value)


@pytest.mark.parametrize(
    ("fraction", "word"),
    [
        (0.0, "0000"),
        (0.5, "0800"),
        (0.75, "0c00"),
        (1.0, "0fff"),
        (2.0, "0fff"),
        (-0.5, "0000"),
        (float("nan"), "0000"),
    ],
)
def test_mcp3221_words(fraction: float, word: str) -> None:
    chip = Mcp3221(constant(fraction))  # type: ignore[arg-type]  # a sample source
    assert chip.read(4, LINE).hex() == word * 2
    assert chip.read(3, LINE).hex() == (word * 2)[:6]


def test_the_first_word_after_a_pause_is_an_old_one() -> None:
    chip = Mcp3221(lambda t: t / 20.0)
    chip.read(200, LINE)
    fresh = chip.read(4, SclTiming(10.01, 400e3))
    old = chip.read(4, SclTiming(11.0, 400e3))
    assert int.from_bytes(fresh[:2], "big") == int(4096 * 10.01 / 20)
    assert int.from_bytes(old[:2], "big") == int(4096 * 10.01 / 20)
    assert int.from_bytes(old[2:], "big") == int(4096 * 11.0 / 20)


def test_adc121c021_alert_flag_is_the_top_bit() -> None:
    chip = Adc121c021(constant(0.25))  # type: ignore[arg-type]  # a sample source
    chip.write(b"\x03\x05\x00", 0.0)  # low limit above what is converted
    chip.write(b"\x02\x08", 0.0)  # alert flag enabled
    chip.write(b"\x00", 0.0)
    assert chip.read(2, LINE).hex() == "8400"
    chip.power_on(0.0)
    assert chip.read(2, LINE).hex() == "0400"


def test_ads1115_continuous() -> None:
    chip = Ads1x15(constant(0.5), supply_v=3.3)  # type: ignore[arg-type]  # a sample source
    chip.write(b"\x01\x42\x83", 10.0)
    chip.write(b"\x00", 10.0)
    assert chip.read(2, SclTiming(10.0 + 0.9 / 128, 400e3)).hex() == "0000"  # the first conversion is still running
    assert chip.read(4, SclTiming(10.0 + 1.1 / 128, 400e3)).hex() == f"{round(1.65 / 4.096 * 32768):04x}" * 2
    chip.write(b"\x01", 10.1)
    assert chip.read(2, SclTiming(10.1, 400e3)).hex() == "4283"


def test_ads1115_keeps_the_old_result_while_the_new_range_takes_effect() -> None:
    chip = Ads1x15(constant(0.25))  # type: ignore[arg-type]  # a sample source
    chip.write(b"\x01\x42\x83", 0.0)
    old = round(0.825 / 4.096 * 32768)
    chip.write(b"\x01\x44\x83", 1.0)  # 2.048 V
    chip.write(b"\x00", 1.0)
    assert int.from_bytes(chip.read(2, SclTiming(1.0 + 1.9 / 128, 400e3)), "big") == old
    assert int.from_bytes(chip.read(2, SclTiming(1.0 + 2.1 / 128, 400e3)), "big") == round(0.825 / 2.048 * 32768)


def test_ads1015_is_left_justified_and_slow_or_fast() -> None:
    chip = Ads1x15(lambda t: t / 100.0, bits=12, oscillator=-0.1)
    chip.write(b"\x01\x42\x83", 0.0)  # DR 4 is 1600 samples/s here
    chip.write(b"\x00", 0.0)
    word = int.from_bytes(chip.read(2, SclTiming(50.0, 400e3)), "big")
    assert word & 0xF == 0
    assert word == round(0.5 * 3.3 / 4.096 * 32768) & 0xFFF0
    assert chip.read(2, SclTiming(0.9 / 1440, 400e3)) == b"\x00\x00"
    assert chip.read(2, SclTiming(1.1 / 1440, 400e3)) == b"\x00\x00"  # 0.35 ms of a slow rise: below one step


def test_ads1115_single_shot() -> None:
    chip = Ads1x15(constant(0.5))  # type: ignore[arg-type]  # a sample source
    chip.write(b"\x01\xc3\x83", 1.0)
    assert chip.read(2, SclTiming(1.0 + 0.5 / 128, 400e3)).hex() == "4383"  # busy
    assert chip.read(2, SclTiming(1.0 + 1.5 / 128, 400e3)).hex() == "c383"  # done
    chip.write(b"\x00", 1.1)
    assert chip.read(2, SclTiming(1.1, 400e3)) != b"\x00\x00"


def test_lm75() -> None:
    chip = Lm75()
    assert chip.read(2, LINE).hex() == "1900"
    chip.write(b"\x02", 0.0)
    assert chip.read(2, LINE).hex() == "4b00"
