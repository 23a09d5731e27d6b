"""The block of the cycle: places, units, and what is not known."""

from __future__ import annotations

import struct

from daemon.cli import status_table
from daemon.publish.modbus import integrity_block, registers, timing_block
from daemon.snapshot import CycleTiming, Stage
from estimator.measurements import DegradationLevel
from tests.daemon.publish.modbus.test_registers import snapshot

PULSE = CycleTiming(
    rung=2,
    thinned=70_001,
    without_map=2,
    carried=3,
    stalls=4,
    stall_s=0.1234,
    stall_in=Stage.MATCH,
    cycle=(3000, 8000, 9123),
    late=(100, 1500, 2_000_000),
    stages=(*((10 * k, 20 * k, 30 * k) for k in range(7)), None),
)


def test_every_rung_of_the_estimator_has_a_meaning() -> None:
    assert [rung.value for rung in DegradationLevel] == list(range(len(timing_block.RUNGS)))


def test_block_by_hand() -> None:
    """Numbers at places written down here, not taken from the table."""
    words = struct.unpack(">46H", timing_block.BLOCK.encode(snapshot(pulse=PULSE)))
    assert words[:14] == (0x4C43, 1, 1, 4464, 2, 1, 4465, 0, 2, 0, 3, 4, 123, 3)
    assert words[14:20] == (300, 800, 912, 10, 150, 65_534), "hundredths of a millisecond; the largest: this or more"
    assert words[20:26] == (0, 0, 0, 1, 2, 3)
    assert words[38:44] == (6, 12, 18, 0xFFFF, 0xFFFF, 0xFFFF)
    assert words[44:] == (1, 4464)
    assert timing_block.BLOCK.address + len(words) == 400


def test_what_is_not_known_says_so() -> None:
    for empty in (snapshot(), snapshot(pulse=CycleTiming())):
        reading = timing_block.BLOCK.decode(timing_block.BLOCK.encode(empty))
        known = {name: value for name, value in reading.items() if value is not None}
        assert known == {"seq": 70_000, "rung": 0, "thinned": 0, "without_map": 0, "carried": 0, "stalls": 0}


def test_status_tells_what_is_left_out_and_when_it_stood_still() -> None:
    reading = registers.decode_block(registers.encode_block(snapshot()))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot()))
    calm = status_table.as_table(
        reading | timing_block.BLOCK.decode(timing_block.BLOCK.encode(snapshot(pulse=CycleTiming()))), stalled=False
    )
    assert "over budget\n" in calm
    table = status_table.as_table(
        reading | timing_block.BLOCK.decode(timing_block.BLOCK.encode(snapshot(pulse=PULSE))), stalled=False
    )
    assert "99 of 100 within 0.00800 s; also no map work; 4 stalls, latest 0.123 s in MATCH" in table
