"""The block of the cycle: places, units, what is not known, and the frozen contract."""

from __future__ import annotations

import json
import struct
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from daemon.cli import status_table
from daemon.publish import document
from daemon.publish.modbus import integrity_block, lights_block, registers, timing_block
from daemon.publish.modbus.requests import Responder
from daemon.snapshot import CycleTiming, Stage
from estimator.measurements import DegradationLevel
from tests.daemon.publish.modbus.test_lights_block import ask, layout
from tests.daemon.publish.modbus.test_registers import snapshot

FROZEN = Path(__file__).parent / "frozen" / f"pulse_v{timing_block.BLOCK.version}.json"

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


@pytest.mark.parametrize(
    ("at", "word", "words"), [(0, 0x4C4C, "magic"), (1, 2, "version 2"), (3, 1, "torn"), (45, 1, "torn")]
)
def test_a_block_that_is_not_ours_is_refused(at: int, word: int, words: str) -> None:
    block = bytearray(timing_block.BLOCK.encode(snapshot()))
    block[2 * at : 2 * at + 2] = word.to_bytes(2, "big")
    with pytest.raises(ValueError, match=words):
        timing_block.BLOCK.decode(bytes(block))
    with pytest.raises(ValueError, match="46 registers, got 4"):
        timing_block.BLOCK.decode(bytes(8))


@pytest.mark.parametrize("function", [3, 4])
def test_clients_read_all_of_it_or_a_part(function: int) -> None:
    responder, taken = Responder(), snapshot(pulse=PULSE)
    encoders = (
        registers.encode_mirror,
        lights_block.BLOCK.encode,
        integrity_block.BLOCK.encode,
        timing_block.BLOCK.encode,
    )
    responder.show(registers.encode_block(taken), *[partial(encode, taken) for encode in encoders])
    assert ask(responder, 354, 46, function)[9:] == timing_block.BLOCK.encode(taken)
    assert ask(responder, 358, 1, function)[9:] == bytes((0, 2))
    for address, count in ((353, 2), (354, 47)):
        assert ask(responder, address, count, function)[7:] == bytes([function | 0x80, 2])


def contract() -> dict[str, Any]:
    return {
        "version": timing_block.BLOCK.version,
        "magic": timing_block.BLOCK.magic,
        "address": timing_block.BLOCK.address,
        "registers": timing_block.BLOCK.registers,
        "block": layout(timing_block.BLOCK),
        "rungs": len(timing_block.RUNGS),
        "stages": {stage.name: stage.value for stage in Stage},
    }


def test_the_contract_is_the_frozen_one() -> None:
    """A published layout is never edited: anything that is not the same needs a new version."""
    assert contract() == json.loads(FROZEN.read_text())


def test_the_page_says_where_everything_is() -> None:
    modbus = document.modbus_page()
    for offset, point in zip(timing_block.BLOCK.offsets, timing_block.BLOCK.points, strict=True):
        assert f"| {356 + offset} | `{point.name}` | {point.wire.name} |" in modbus


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
    assert "99 of 100 within 0.00800 s; no map work either; stood still 4 times, latest 0.123 s in MATCH" in table
