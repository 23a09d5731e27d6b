"""The block of PWM-dimmed lamps: places, units, what is not known, and the name that a person reads."""

from __future__ import annotations

import struct

import pytest

from daemon.cli.status_table import as_table
from daemon.publish.modbus import dimmed_block, lights_block, registers
from daemon.snapshot import DimmedLamp
from tests.daemon.publish.modbus.test_lights_block import picture
from tests.daemon.publish.modbus.test_registers import snapshot

DIMMED = (DimmedLamp(1000.04, 4.99e-6), DimmedLamp(15_000.0, 0.5e-6, 7222.2))


def test_block_by_hand() -> None:
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
