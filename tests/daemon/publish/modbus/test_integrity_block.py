"""The block of integrity and the end of the datagram: places, units, and what is not known."""

from __future__ import annotations

import struct
import zlib

import estimator.result
from daemon.cli import status_table
from daemon.cli.reports.status import as_object
from daemon.publish.modbus import integrity_block, registers
from daemon.runtime.snapshot_builder import LOOPS
from daemon.snapshot import LoopReason, Trust
from tests.daemon.publish.modbus.test_registers import snapshot

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


def test_status_shows_the_bound() -> None:
    taken = snapshot(trust=TRUST, loop_residual=0.0123)
    reading = registers.decode_block(registers.encode_block(taken))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(taken))
    table = status_table.as_table(reading, stalled=False)
    assert "protection 0.124 m, 2.01 deg (lidar, odometry)  ALERT, limit 0.500 m" in table
    assert "hypotheses 3" in table
    assert "residual 0.0123 m" in table
    assert as_object(reading, stalled=False)["integrity"]["witnesses"]["alert"] is True
    reading = registers.decode_block(registers.encode_block(snapshot()))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot()))
    assert "protection none" in status_table.as_table(reading, stalled=False)
