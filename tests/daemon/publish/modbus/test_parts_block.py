"""The block of the parts: places, what is listed, and the frozen contract."""

from __future__ import annotations

import json
import struct
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from daemon.cli import status_table
from daemon.health.faults import Fault
from daemon.publish import document
from daemon.publish.modbus import integrity_block, lights_block, parts_block, registers, timing_block
from daemon.publish.modbus.requests import BLOCKS, Responder
from daemon.snapshot import Condition, Part, Thread
from tests.daemon.publish.modbus.test_lights_block import ask, layout
from tests.daemon.publish.modbus.test_registers import snapshot

FROZEN = Path(__file__).parent / "frozen" / f"parts_v{parts_block.BLOCK.version}.json"

CONDITION = Condition(
    uptime_s=70_001,
    faults=(104, 151, 201),
    restarts=(1, 2, 0, 0, 0, 0, 65_537, 0, 0, 0, 9),
    down=frozenset([Part.LIDAR, Part.MAP]),
    hanging=frozenset([Thread.I2C]),
)


def test_block_by_hand() -> None:
    """Numbers at places written down here, not taken from the table."""
    words = struct.unpack(">34H", parts_block.BLOCK.encode(snapshot(condition=CONDITION)))
    assert words[:7] == (0x4C46, 1, 1, 4464, 1, 4465, 3)
    assert words[7:19] == (104, 151, 201, *([0] * 9))
    assert words[19:30] == (1, 2, 0, 0, 0, 0, 1, 0, 0, 0, 9)
    assert words[30:32] == (0b10_0000_0001, 0b10_0000)
    assert words[32:] == (1, 4464)
    assert parts_block.BLOCK.address + len(words) == 434


def test_more_faults_than_can_be_named_are_counted() -> None:
    many = tuple(int(fault) for fault in Fault)[1:20]
    reading = parts_block.BLOCK.decode(parts_block.BLOCK.encode(snapshot(condition=Condition(faults=many))))
    assert reading["faults"] == 19
    assert [reading[f"fault_{k + 1}"] for k in range(12)] == list(many[:12])


def test_before_the_first_look_there_is_nothing() -> None:
    reading = parts_block.BLOCK.decode(parts_block.BLOCK.encode(snapshot()))
    assert {name: value for name, value in reading.items() if value} == {"seq": 70_000}


@pytest.mark.parametrize(
    ("at", "word", "words"), [(0, 0x4C4C, "magic"), (1, 2, "version 2"), (3, 1, "torn"), (33, 1, "torn")]
)
def test_a_block_that_is_not_ours_is_refused(at: int, word: int, words: str) -> None:
    block = bytearray(parts_block.BLOCK.encode(snapshot()))
    block[2 * at : 2 * at + 2] = word.to_bytes(2, "big")
    with pytest.raises(ValueError, match=words):
        parts_block.BLOCK.decode(bytes(block))
    with pytest.raises(ValueError, match="34 registers, got 4"):
        parts_block.BLOCK.decode(bytes(8))


@pytest.mark.parametrize("function", [3, 4])
def test_clients_read_all_of_it_or_a_part(function: int) -> None:
    responder, taken = Responder(), snapshot(condition=CONDITION)
    encoders = (
        *(registers.encode_mirror, lights_block.BLOCK.encode, integrity_block.BLOCK.encode),
        *(timing_block.BLOCK.encode, parts_block.BLOCK.encode),
    )
    responder.show(registers.encode_block(taken), *[partial(encode, taken) for encode in encoders])
    assert ask(responder, 400, 34, function)[9:] == parts_block.BLOCK.encode(taken)
    assert ask(responder, 407, 1, function)[9:] == bytes((0, 104))
    assert ask(responder, 400, 35, function)[7:] == bytes([function | 0x80, 2])


def contract() -> dict[str, Any]:
    return {
        "version": parts_block.BLOCK.version,
        "magic": parts_block.BLOCK.magic,
        "address": parts_block.BLOCK.address,
        "registers": parts_block.BLOCK.registers,
        "block": layout(parts_block.BLOCK),
        "parts": {part.name: part.value for part in Part},
        "threads": {thread.name: thread.value for thread in Thread},
    }


def test_the_contract_is_the_frozen_one() -> None:
    """A published layout is never edited: anything that is not the same needs a new version."""
    assert contract() == json.loads(FROZEN.read_text())


def test_everything_that_is_numbered_has_a_meaning_and_is_on_the_page() -> None:
    assert list(parts_block.PARTS) == list(Part)
    assert list(parts_block.THREADS) == list(Thread)
    modbus = document.modbus_page()
    for offset, point in zip(parts_block.BLOCK.offsets, parts_block.BLOCK.points, strict=True):
        assert f"| {402 + offset} | `{point.name}` | {point.wire.name} |" in modbus


def test_status_tells_all_faults_and_what_was_restarted() -> None:
    reading = registers.decode_block(registers.encode_block(snapshot(fault=104)))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot()))
    table = status_table.as_table(
        reading | parts_block.BLOCK.decode(parts_block.BLOCK.encode(snapshot(condition=CONDITION))), False
    )
    for words in (
        "104: the lidar",
        "151: the photodiode",
        "201: configured odometry",
        "restarted: LIDAR 1, PHOTODIODE",
    ):
        assert words in table
    assert "running    70001 s" in table
    assert "down: LIDAR, MAP; hanging: I2C" in table


def test_no_two_blocks_have_one_magic_number() -> None:
    magic = [block.magic for block in BLOCKS]
    assert len({registers.MODBUS_MAGIC, *magic}) == 1 + len(magic)
    assert (
        f'0x{parts_block.BLOCK.magic:04X} ("{parts_block.BLOCK.magic.to_bytes(2, "big").decode()}")'
        in document.modbus_page()
    )
