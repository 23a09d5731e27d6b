"""The block of integrity and the end of the datagram: places, units, what is not known, and the frozen contract."""

from __future__ import annotations

import json
import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import estimator.result
from daemon.cli import status_table
from daemon.publish import document
from daemon.publish.modbus import integrity_block, lights_block, registers
from daemon.publish.modbus.requests import Responder
from daemon.runtime.snapshot_builder import LOOPS
from daemon.snapshot import LoopReason, Trust
from tests.daemon.publish.modbus.test_lights_block import ask, layout
from tests.daemon.publish.modbus.test_registers import snapshot

FROZEN = Path(__file__).parent / "frozen" / f"integrity_v{integrity_block.BLOCK.version}.json"

TRUST = Trust(0.12301, 0.0351, 0.5, True, laser=True, wheels=True, gap=6.25, places=3)


def test_every_reason_of_the_estimator_has_a_number() -> None:
    assert {why.name for why in estimator.result.LoopReason} == set(LoopReason.__members__) - {"OTHER"}
    assert LoopReason.OTHER not in LOOPS.values()


def test_block_by_hand() -> None:
    """Numbers at places written down here, not taken from the table."""
    taken = snapshot(trust=TRUST, loop_reason=LoopReason.LIT, loop_residual=0.01234)
    words = struct.unpack(">14H", integrity_block.BLOCK.encode(taken))
    assert words == (0x4C50, 1, 1, 4464, 124, 351, 500, 0b1101, 250, 3, 4, 124, 1, 4464)


def test_bits_of_the_first_block() -> None:
    flags = registers.decode_bits(
        registers.FLAGS, registers.decode_block(registers.encode_block(snapshot(trust=TRUST)))["flags"]
    )
    assert flags["bounded"]
    assert flags["alert"]
    assert not registers.decode_bits(
        registers.FLAGS, registers.decode_block(registers.encode_block(snapshot()))["flags"]
    )["bounded"]


def test_what_is_not_known_says_so() -> None:
    reading = integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot()))
    assert {name: value for name, value in reading.items() if value is not None} == {"seq": 70_000, "witnesses": 0}


def test_a_bound_is_never_published_too_small() -> None:
    reading = integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot(trust=Trust(0.1230001, 0.03500001))))
    assert reading["protection"] == 0.124
    assert reading["protection_yaw"] == 0.0351
    vast = integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot(trust=Trust(1e9, float("inf")))))
    assert vast["protection"] == 65.534
    assert vast["protection_yaw"] == 6.5534


def test_the_end_of_the_datagram_by_hand() -> None:
    data = registers.encode_datagram(snapshot(trust=TRUST, loop_reason=LoopReason.NEAR, loop_residual=0.02))
    assert len(data) == 172
    assert struct.unpack_from("<8H", data, 152) == (124, 351, 500, 0b1101, 250, 3, 1, 200)


def test_a_datagram_of_a_program_that_knew_no_bound_is_read() -> None:
    data = registers.encode_datagram(snapshot(trust=TRUST))
    shorter = data[:6] + struct.pack("<H", 156) + data[8:152]
    shorter += struct.pack("<I", zlib.crc32(shorter))
    reading = registers.decode_datagram(shorter)
    assert reading["map_x"] == 1.2345
    assert "light_x" in reading
    assert "protection" not in reading


@pytest.mark.parametrize(
    ("at", "word", "words"), [(0, 0x4C4C, "magic"), (1, 2, "version 2"), (3, 1, "torn"), (13, 1, "torn")]
)
def test_a_block_that_is_not_ours_is_refused(at: int, word: int, words: str) -> None:
    block = bytearray(integrity_block.BLOCK.encode(snapshot()))
    block[2 * at : 2 * at + 2] = word.to_bytes(2, "big")
    with pytest.raises(ValueError, match=words):
        integrity_block.BLOCK.decode(bytes(block))
    with pytest.raises(ValueError, match="14 registers, got 4"):
        integrity_block.BLOCK.decode(bytes(8))


@pytest.mark.parametrize("function", [3, 4])
def test_clients_read_all_of_it_or_a_part(function: int) -> None:
    responder, taken = Responder(), snapshot(trust=TRUST)
    encoders = (registers.encode_mirror, lights_block.BLOCK.encode, integrity_block.BLOCK.encode)
    responder.show(registers.encode_block(taken), *[partial(encode, taken) for encode in encoders])
    assert ask(responder, 340, 14, function)[9:] == integrity_block.BLOCK.encode(taken)
    assert ask(responder, 344, 2, function)[9:] == integrity_block.BLOCK.encode(taken)[8:12]
    for address, count in ((339, 2), (340, 15)):
        assert ask(responder, address, count, function)[7:] == bytes([function | 0x80, 2])


def test_status_shows_the_bound() -> None:
    taken = snapshot(trust=TRUST, loop_residual=0.0123)
    reading = registers.decode_block(registers.encode_block(taken))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(taken))
    table = status_table.as_table(reading, stalled=False)
    assert "bound      0.124 m, 2.01 deg (laser, wheels)  ALERT, limit 0.500 m" in table
    assert "places     3 fit" in table
    assert "residual 0.0123 m" in table
    assert status_table.as_object(reading, stalled=False)["witnesses"]["alert"] is True
    reading = registers.decode_block(registers.encode_block(snapshot()))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot()))
    assert "bound      none" in status_table.as_table(reading, stalled=False)


def contract() -> dict[str, Any]:
    return {
        "version": integrity_block.BLOCK.version,
        "magic": integrity_block.BLOCK.magic,
        "address": integrity_block.BLOCK.address,
        "registers": integrity_block.BLOCK.registers,
        "datagram_from": registers.TRUST_OFFSET,
        "block": layout(integrity_block.BLOCK),
        "tail": layout(integrity_block.TAIL),
        "witnesses": [name for name, _, _ in integrity_block.WITNESSES],
        "reasons": {why.name: why.value for why in LoopReason},
    }


def test_the_contract_is_the_frozen_one() -> None:
    """A published layout is never edited: bits and reasons may be appended, anything else needs a new version."""
    frozen, now = json.loads(FROZEN.read_text()), contract()
    reasons = frozen.pop("reasons")
    assert {name: now["reasons"].get(name) for name in reasons} == reasons
    now.pop("reasons")
    assert now.pop("witnesses")[: len(frozen["witnesses"])] == frozen.pop("witnesses")
    assert now == frozen


def test_the_pages_say_where_everything_is() -> None:
    modbus, udp = document.modbus_page(), document.udp_page()
    for offset, point in zip(integrity_block.BLOCK.offsets, integrity_block.BLOCK.points, strict=True):
        assert f"| {342 + offset} | `{point.name}` | {point.wire.name} |" in modbus
    for offset, point in zip(integrity_block.TAIL.offsets, integrity_block.TAIL.points, strict=True):
        assert f"| {152 + 2 * offset} | `{point.name}` | {point.wire.name} |" in udp
