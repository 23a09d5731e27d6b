"""The blocks of lights and of PWM-dimmed lamps, and the end of the datagram: places, units, unknown values."""

import math
import struct
import zlib
from typing import Any

import pytest

from daemon.cli.status_table import as_table
from daemon.publish.modbus import dimmed_block, lights_block, registers
from daemon.snapshot import DimmedLamp, LightFix, LightLink, LightPicture, LinkUse
from estimator.result import Fix, LinkState
from tests.daemon.publish.modbus.test_registers import snapshot

LINKS = (
    LightLink(17, 1017, LinkUse.ACCEPTED, 1.25e-6, -0.031),
    LightLink(60, None, LinkUse.TWIN, 0.5e-6),
    LightLink(101, 65_000, LinkUse.OCCLUDED, 3.1e-9, -4.0),
)


def picture(**changes: Any) -> LightPicture:
    plain: dict[str, Any] = {
        "fix": LightFix.GOOD,
        "used": 5,
        "t_mono": 1234.475,
        "pose": (-1.2345, 7.25, 3.5),
        "sigma": (0.02101, 0.03, 0.01),
        "floor": 0.0153,
        "clock_ppm": -2750.4,
        "blocks": 70_001,
        "blocks_lost": 3,
        "links": LINKS,
    }
    return LightPicture(**(plain | changes))


def test_every_state_of_the_estimator_has_a_number() -> None:
    assert {fix.name for fix in Fix} == set(LightFix.__members__)
    assert {state.name for state in LinkState} == set(LinkUse.__members__) - {"OTHER"}


def test_block_by_hand() -> None:
    """Bytes at places written down here, not taken from the table."""
    words = struct.unpack(">120H", lights_block.BLOCK.encode(snapshot(light=picture())))
    assert words[:4] == (0x4C49, 1, 1, 70_000 - 65_536)
    assert words[4:6] == (2, 5)
    assert struct.unpack(">iii", struct.pack(">6H", *words[6:12])) == (-12_345, 72_500, round(1e6 * (3.5 - math.tau)))
    assert words[12:17] == (211, 300, 100, 500, 153)
    assert words[17] == 65_536 - 2750
    assert words[18:22] == (1, 4465, 0, 3)
    assert words[22:28] == (17, 1017, 1, 1_250_000 >> 16, 1_250_000 & 0xFFFF, 65_536 - 310)
    assert words[28:34] == (60, 0xFFFF, 6, 500_000 >> 16, 500_000 & 0xFFFF, 0x8000)
    assert words[34:40] == (101, 65_000, 2, 0, 3100, 65_536 - 32_767), "a residual beyond the range saturates"
    assert set(words[40:118:6]) == {0xFFFF}, "no further link"
    assert words[118:] == words[2:4]


def test_a_reader_gets_values_in_si_units() -> None:
    reading = lights_block.BLOCK.decode(lights_block.BLOCK.encode(snapshot(light=picture())))
    assert (reading["light_fix"], reading["light_used"], reading["seq"]) == (2, 5, 70_000)
    assert reading["light_x"] == -1.2345
    assert reading["light_age"] == pytest.approx(0.05)
    assert reading["sample_clock"] == -2750
    assert reading["link_1_strength"] == pytest.approx(1.25e-6)
    assert reading["link_1_residual"] == -0.031
    assert reading["link_2_lamp"] is None
    assert reading["link_4_code"] is None


@pytest.mark.parametrize("light", [None, LightPicture()])
def test_what_is_not_known_says_so(light: LightPicture | None) -> None:
    reading = lights_block.BLOCK.decode(lights_block.BLOCK.encode(snapshot(light=light)))
    counted = {"seq": 70_000, "blocks": 0, "blocks_lost": 0}
    known = {name: value for name, value in reading.items() if value is not None and name not in counted}
    assert known == ({} if light is None else {"light_fix": 0, "light_used": 0})
    assert {name: reading[name] for name in counted} == counted


def test_only_the_strongest_sixteen_are_shown() -> None:
    many = tuple(LightLink(code, code, LinkUse.ACCEPTED, 1e-6 / (code + 1)) for code in range(40))
    reading = lights_block.BLOCK.decode(lights_block.BLOCK.encode(snapshot(light=picture(links=many))))
    assert [reading[f"link_{row}_code"] for row in range(1, 17)] == list(range(16))


def test_the_end_of_the_datagram_by_hand() -> None:
    data = registers.encode_datagram(snapshot(light=picture()))
    assert len(data) == 172
    assert struct.unpack_from("<HHiii", data, 128) == (2, 5, -12_345, 72_500, round(1e6 * (3.5 - math.tau)))
    assert struct.unpack_from("<4H", data, 144) == (211, 300, 100, 500)
    assert registers.decode_datagram(data)["light_y"] == 7.25


def test_a_datagram_of_a_program_that_knew_no_lights_is_read() -> None:
    data = registers.encode_datagram(snapshot(light=picture()))
    shorter = data[:6] + struct.pack("<H", 132) + data[8:128]
    shorter += struct.pack("<I", zlib.crc32(shorter))
    reading = registers.decode_datagram(shorter)
    assert reading["map_x"] == 1.2345
    assert "light_x" not in reading


DIMMED = (DimmedLamp(1000.04, 4.99e-6), DimmedLamp(15_000.0, 0.5e-6, 7222.2))


def test_block_of_dimmed_lamps_by_hand() -> None:
    words = struct.unpack(">24H", dimmed_block.BLOCK.encode(snapshot(light=picture(dimmed=DIMMED))))
    assert words[:2] == (0x4C44, 1)
    numbers = struct.unpack(">9I", struct.pack(">18H", *words[4:22]))
    unknown = 0xFFFF_FFFF
    assert numbers == (10_000, unknown, 4_990_000, 150_000, 72_222, 500_000, unknown, unknown, unknown)
    assert words[22:] == words[2:4]


@pytest.mark.parametrize(
    ("lamp", "name"),
    [
        (DIMMED[0], "a PWM lamp of 1.0 kHz, 5 uA"),
        (DIMMED[1], "a PWM lamp of 15.0 kHz or 7.2 kHz, 0.5 uA"),
        (DimmedLamp(237.2, 1.25e-6), "a PWM lamp of 237 Hz, 1.2 uA"),
    ],
)
def test_a_lamp_is_named(lamp: DimmedLamp, name: str) -> None:
    assert str(lamp) == name


def test_status_shows_the_lamps_and_reads_daemons_without_the_block() -> None:
    shown = snapshot(light=picture(dimmed=DIMMED))
    reading = registers.decode_block(registers.encode_block(shown))
    reading |= lights_block.BLOCK.decode(lights_block.BLOCK.encode(shown))
    assert "dimmed" not in as_table(reading, False)
    reading |= dimmed_block.BLOCK.decode(dimmed_block.BLOCK.encode(shown))
    lines = as_table(reading, False).splitlines()
    at = lines.index("dimmed     a PWM lamp of 1.0 kHz, 5 uA")
    assert lines[at + 1].strip() == "a PWM lamp of 15.0 kHz or 7.2 kHz, 0.5 uA"
