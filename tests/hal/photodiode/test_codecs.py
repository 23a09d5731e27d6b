"""Bytes of the converters, by their data sheets, worked out by hand."""

import re

import numpy as np
import pytest

from hal.adc import Blemish
from hal.photodiode import adc121c021, ads1x15, mcp3221
from hal.photodiode.block_check import STUCK_RUN, inspect
from hal.photodiode.chips import BlockChip, chip_named

MCP = mcp3221.CHIP


def words_of(text: str, asked: int = 0) -> tuple[list[int], Blemish]:
    data = bytes.fromhex(text)
    words, blemish, _ = inspect(data, asked or len(data), MCP.spare, MCP.bits)
    return words.tolist(), blemish


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("08 00", [2048]),  # Vin = VDD / 2
        ("00 21 0f de", [33, 4062]),
        ("01 23 04 56 07 89 0a bc", [0x123, 0x456, 0x789, 0xABC]),
        ("01 23 04", [0x123]),  # half a word is none
    ],
)
def test_words(text: str, words: list[int]) -> None:
    assert words_of(text) == (words, Blemish.NONE)


@pytest.mark.parametrize(
    ("text", "blemish"),
    [
        ("00 00 08 00", Blemish.CLIPPED),
        ("00 20 08 00", Blemish.CLIPPED),  # 26 mV of 3.3 V: as far as an amplifier gets
        ("08 00 0f df", Blemish.CLIPPED),
        ("0f ff 08 00", Blemish.CLIPPED),
        ("18 00 08 01", Blemish.MISALIGNED),
        ("88 00 08 01", Blemish.MISALIGNED),  # an ADC121C021's alert flag, which is switched off
        ("ff ff ff ff", Blemish.MISALIGNED),
        ("08 00 07 ff ff ff", Blemish.SHORT),
        ("08 00 ff ff 07 ff", Blemish.MISALIGNED | Blemish.CLIPPED),
    ],
)
def test_blemishes(text: str, blemish: Blemish) -> None:
    assert words_of(text)[1] == blemish


def test_words_that_were_not_sent_are_cut_off() -> None:
    assert words_of("08 00 07 ff ff ff ff ff") == ([0x800, 0x7FF], Blemish.SHORT)


def test_fewer_bytes_than_asked_for() -> None:
    assert words_of("08 00 07 ff", asked=8) == ([0x800, 0x7FF], Blemish.SHORT)
    assert words_of("", asked=8) == ([], Blemish.SHORT)
    assert words_of("08", asked=8) == ([], Blemish.SHORT)


def block(words: list[int]) -> bytes:
    return b"".join(word.to_bytes(2, "big") for word in words)


@pytest.mark.parametrize(("run", "stuck"), [(STUCK_RUN - 1, False), (STUCK_RUN, True)])
@pytest.mark.parametrize("at", [0, 100, 400])
def test_a_long_run_of_one_word_is_stuck(run: int, stuck: bool, at: int) -> None:
    words = [2000 + k % 7 for k in range(500)]
    words[at : at + run] = [1234] * run
    _, blemish, defects = inspect(block(words[: at + run + 50]), 2 * len(words[: at + run + 50]), 0xF000, 12)
    assert (Blemish.STUCK in blemish) == defects.stuck == stuck


def test_a_long_run_at_a_rail_is_clipped_not_stuck() -> None:
    words = [2000 + k % 7 for k in range(500)]
    words[100:300] = [4095] * 200
    _, blemish, defects = inspect(block(words), 1000, 0xF000, 12)
    assert blemish == Blemish.CLIPPED
    assert defects.clipped == pytest.approx(0.4)
    assert not defects.constant


def test_a_whole_block_at_a_rail_is_constant() -> None:
    _, blemish, defects = inspect(bytes(1000), 1000, 0xF000, 12)
    assert blemish == Blemish.CLIPPED
    assert defects.constant
    assert not defects.floated


LIVE = [2000 + 37 * k % 101 for k in range(500)]
"""Words of a live signal."""


@pytest.mark.parametrize("places", [[0], [7], [499], [10, 40, 250], [0, 9, 18], list(range(5, 500, 50))])
@pytest.mark.parametrize("mask", [0x8000, 0x1000, 0xF000, 0xFFFF, 0x4321])
def test_single_damaged_words_cost_these_words_only(places: list[int], mask: int) -> None:
    smooth = [2000 + k for k in range(500)]
    hit = [word ^ mask if k in places else word for k, word in enumerate(smooth)]
    words, blemish, defects = inspect(block(hit), 1000, 0xF000, 12)
    assert blemish == Blemish.REPAIRED
    assert (defects.repaired, defects.misaligned) == (len(places), 0.0)
    assert np.abs(words.astype(int) - smooth).max() <= (1 if {0, 499} & set(places) else 0)


@pytest.mark.parametrize("places", [[100, 101], [100, 108], list(range(0, 500, 40)), [3, 100, 104, 400]])
def test_damaged_words_close_together_or_many_are_a_shift(places: list[int]) -> None:
    hit = [word | 0x8000 if k in places else word for k, word in enumerate(LIVE)]
    words, blemish, defects = inspect(block(hit), 1000, 0xF000, 12)
    assert blemish == Blemish.MISALIGNED
    assert defects.misaligned == len(places) / 500
    assert words.tolist() == LIVE


def shifted(words: list[int], bits: int, at: int = 0) -> bytes:
    """The bytes of words after the loss of some clocks before word ``at``; the missing bits at the end read 1."""
    kept, rest = block(words[:at]), block(words[at:])
    number = (int.from_bytes(rest, "big") << bits) | ((1 << bits) - 1)
    return kept + (number & ((1 << 8 * len(rest)) - 1)).to_bytes(len(rest), "big")


@pytest.mark.parametrize("at", [0, 100, 400])
@pytest.mark.parametrize("bits", [1, 2, 3, 4, 5])
def test_lost_high_bits_show_where_all_words_are_low(bits: int, at: int) -> None:
    """No spare bit is set: the words are merely too large."""
    low = [40 + 13 * k % 23 for k in range(500)]
    _, blemish, defects = inspect(shifted(low, bits, at), 1000, 0xF000, 12)
    assert Blemish.MISALIGNED in blemish
    assert defects.lost_bits
    assert defects.misaligned >= (500 - at - 10) / 500


@pytest.mark.parametrize(
    "words",
    [
        [40 + 13 * k % 23 for k in range(500)],
        [40 + 2 * (k % 2) for k in range(500)],  # an input that toggles
        [2048] * 500,
        [57, 40, 28] + [16] * 497,  # at the lower rail, after a slope
    ],
    ids=["live", "toggles", "constant", "rail"],
)
def test_no_bits_are_lost(words: list[int]) -> None:
    _, blemish, defects = inspect(block(words), 1000, 0xF000, 12)
    assert Blemish.MISALIGNED not in blemish
    assert not defects.lost_bits


def test_census_counts_words_with_bits_too_many() -> None:
    _, _, defects = inspect(block([0x1800, 0x0800, 0x0801, 0x0802]), 8, 0xF000, 12)
    assert defects.misaligned == 0.25


@pytest.mark.parametrize("name", ["mcp3221", "MCP3221", "Adc121c021", "adc121C027"])
def test_chips_by_name(name: str) -> None:
    chip = chip_named(name)
    assert chip.name == name.upper()
    assert chip.bits == 12


@pytest.mark.parametrize(
    ("answer", "wrong"),
    [(None, False), (b"\x00\x12", False), (b"\x0f\xff", False), (b"\x85\x83", True), (b"\xff\xff", True)],
)
def test_mcp3221_has_no_registers(answer: bytes | None, wrong: bool) -> None:
    assert [(query.select, query.length) for query in MCP.queries] == [(b"\x01", 2)]
    assert bool(MCP.mismatch((answer,))) == wrong


def test_adc121c021_is_asked_and_set_up_by_its_registers() -> None:
    chip = adc121c021.ADC121C021
    asked = [(query.select, query.length) for query in chip.queries]
    assert asked == [(b"\x02", 1), (b"\x03", 2), (b"\x04", 2), (b"\x05", 2)]
    assert chip.setup == (b"\x02\x00", b"\x00")  # automatic conversion and alerts off; pointer at the result
    assert chip.mismatch((b"\x00", b"\x00\x00", b"\x0f\xff", b"\x00\x00")) == ""
    assert chip.mismatch((b"\xe1", b"\x01\x00", b"\x0a\xbc", b"\x00\x10")) == ""  # as another program has left it


@pytest.mark.parametrize(
    ("answers", "says"),
    [
        ((None, None, None, None), "has no registers"),
        ((b"\x00", b"\x00\x00", None, b"\x00\x00"), "has no registers"),
        ((b"\xff", b"\xff\xff", b"\xff\xff", b"\xff\xff"), "bit 1 at zero"),
        ((b"\x00", b"\x4b\x00", b"\x50\x00", b"\x00\x00"), "0x4b00 in register 3"),
    ],
)
def test_what_is_no_adc121c021(answers: tuple[bytes | None, ...], says: str) -> None:
    assert re.search(says, adc121c021.mismatch(answers))


@pytest.mark.parametrize(
    ("configuration", "word"),
    [
        (ads1x15.Configuration(0, 2, 4, single=True, start=True), 0xC597),  # AIN0 to GND, 2.048 V, single
        (ads1x15.Configuration(0, 1, 4), 0x4297),  # AIN0 to GND, 4.096 V, continuous, DR 4
        (ads1x15.Configuration(3, 5, 7), 0x7AF7),  # AIN3 to GND, 0.256 V, continuous, DR 7
    ],
)
def test_ads1x15_configuration(configuration: ads1x15.Configuration, word: int) -> None:
    assert configuration.word() == word
    assert configuration.message() == b"\x01" + word.to_bytes(2, "big")


@pytest.mark.parametrize("fields", [{"channel": 4}, {"channel": -1}, {"pga": 8}, {"rate": 8}])
def test_ads1x15_fields_out_of_range(fields: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(fields))):
        ads1x15.Configuration(**fields).word()  # type: ignore[arg-type]  # keyword names vary


def test_ads1x15_configuration_read_back() -> None:
    wanted = ads1x15.Configuration(0, 1, 4)
    assert ads1x15.same_configuration(b"\x42\x97", wanted)
    assert not ads1x15.same_configuration(b"\x42\x83", wanted), "the same input, as another program writes it"
    assert ads1x15.after_reset(b"\x85\x83")
    assert ads1x15.after_reset(b"\x05\x83")
    assert not ads1x15.after_reset(b"\x42\x97")
    assert ads1x15.same_configuration(b"\xc2\x97", wanted)  # bit 15: no conversion running just now
    assert not ads1x15.same_configuration(b"\x85\x83", wanted)
    assert not ads1x15.same_configuration(b"\x42", wanted)


@pytest.mark.parametrize(
    ("data", "fraction"),
    [("7f ff", 32767 / 32768), ("40 00", 0.5), ("00 00", 0.0), ("ff ff", -1 / 32768), ("80 00", -1.0)],
)
def test_ads1x15_result(data: str, fraction: float) -> None:
    assert ads1x15.fraction(bytes.fromhex(data)) == fraction


@pytest.mark.parametrize(
    ("answers", "right"),
    [
        ((b"\x80\x00", b"\x7f\xff"), True),
        ((b"\x00\x00", b"\x80\x00"), True),  # thresholds of the conversion-ready pin
        ((b"\x4b\x00", b"\x50\x00"), False),  # an LM75
        ((None, None), False),
    ],
)
def test_ads1x15_is_known_by_its_thresholds(answers: tuple[bytes | None, ...], right: bool) -> None:
    assert (ads1x15.mismatch(answers) == "") == right


@pytest.mark.parametrize("chip", [MCP, adc121c021.ADC121C021, adc121c021.ADC121C027], ids=lambda chip: chip.name)
def test_spare_bits_and_bits_make_a_word(chip: BlockChip) -> None:
    assert chip.spare | ((1 << chip.bits) - 1) == 0xFFFF
    assert all(0x08 <= address <= 0x77 for address in chip.addresses)


def test_words_are_right_aligned_unsigned() -> None:
    words, _, _ = inspect(b"\x0f\xfe\x00\x02", 4, 0xF000, 12)
    assert words.dtype == np.uint16
    assert words.tolist() == [4094, 2]


@pytest.mark.parametrize(
    ("sigma", "mean", "quiet"),
    [(0.45, 2048, True), (1.0, 1900, True), (3.0, 2048, False), (0.0, 2048, True), (1.0, 20, False)],
)
def test_noise_alone_is_quiet(sigma: float, mean: float, quiet: bool) -> None:
    """A real converter in the dark does not repeat one word, and an amplifier at a rail is not dark."""
    words = np.round(mean + sigma * np.random.default_rng(1).standard_normal(1111)).astype(">u2")
    _, blemish, defects = inspect(words.tobytes(), words.nbytes, MCP.spare, MCP.bits)
    assert defects.quiet is quiet
    assert (Blemish.CLIPPED in blemish) == (mean < 32)
    assert (Blemish.STUCK in blemish) == (sigma == 0.0)


def test_the_weakest_lamp_in_view_is_not_quiet() -> None:
    """At the edge of the view a lamp 2.6 m above has 67 nA of 50 uA: 5.5 words."""
    chips = np.repeat(np.random.default_rng(2).choice([-1.0, 1.0], 250), 4)
    words = np.round(2048 + 5.5 * chips + 0.45 * np.random.default_rng(3).standard_normal(1000)).astype(">u2")
    assert not inspect(words.tobytes(), words.nbytes, MCP.spare, MCP.bits)[2].quiet
