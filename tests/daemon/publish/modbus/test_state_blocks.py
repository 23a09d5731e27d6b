"""The blocks of integrity, of parts and of the cycle: places, units, unknown values."""

import struct
import zlib

import estimator.result
from daemon.cli import status_table
from daemon.cli.reports.status import as_object
from daemon.health.faults import Fault
from daemon.publish import document
from daemon.publish.modbus import integrity_block, parts_block, registers, timing_block
from daemon.publish.modbus.requests import BLOCKS
from daemon.runtime.snapshot_builder import LOOPS
from daemon.snapshot import Condition, CycleTiming, LoopReason, Part, Stage, Thread, Trust
from estimator.measurements import DegradationLevel
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


CONDITION = Condition(
    uptime_s=70_001,
    faults=(104, 151, 201),
    restarts=(1, 2, 0, 0, 0, 0, 65_537, 0, 0, 0, 9),
    down=frozenset([Part.LIDAR, Part.MAP]),
    hanging=frozenset([Thread.I2C]),
)


def test_block_of_parts_by_hand() -> None:
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


def test_everything_that_is_numbered_has_a_meaning() -> None:
    assert list(parts_block.PARTS) == list(Part)
    assert list(parts_block.THREADS) == list(Thread)


def test_status_tells_all_faults_and_what_was_restarted() -> None:
    reading = registers.decode_block(registers.encode_block(snapshot(fault=104)))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot()))
    table = status_table.as_table(
        reading | parts_block.BLOCK.decode(parts_block.BLOCK.encode(snapshot(condition=CONDITION))), False
    )
    for words in (
        "104: the lidar",
        "151: the photodiode",
        "201: odometry is configured",
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


def test_status_shows_what_follows_from_a_fault_below_it() -> None:
    slow = Condition(faults=(104, 306, 106, 301, 401))
    reading = registers.decode_block(registers.encode_block(snapshot(fault=104)))
    reading |= integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(snapshot()))
    reading |= parts_block.BLOCK.decode(parts_block.BLOCK.encode(snapshot(condition=slow)))
    lines = status_table.as_table(reading, False).splitlines()
    first = next(place for place, line in enumerate(lines) if line.startswith("fault"))
    shown = [line[10:] for line in lines[first : first + 5]]
    assert [line.split(":")[0] for line in shown] == [" 104", " 306", "   follows", "   follows", " 401"]
    assert "106: more than 2 % of the lidar's scans" in shown[2]
    assert "reduce the load" not in shown[3], "the remedy is that of the cause"
    told = as_object(reading, False)["faults"]
    assert [(one["number"], one["cause"]) for one in told] == [
        (104, None), (306, None), (106, 306), (301, 306), (401, None)
    ]  # fmt: skip


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


def test_block_of_the_cycle_by_hand() -> None:
    """Numbers at places written down here, not taken from the table."""
    words = struct.unpack(">46H", timing_block.BLOCK.encode(snapshot(pulse=PULSE)))
    assert words[:14] == (0x4C43, 1, 1, 4464, 2, 1, 4465, 0, 2, 0, 3, 4, 123, 3)
    assert words[14:20] == (300, 800, 912, 10, 150, 65_534), "hundredths of a millisecond; the largest: this or more"
    assert words[20:26] == (0, 0, 0, 1, 2, 3)
    assert words[38:44] == (6, 12, 18, 0xFFFF, 0xFFFF, 0xFFFF)
    assert words[44:] == (1, 4464)
    assert timing_block.BLOCK.address + len(words) == 400


def test_what_is_not_known_of_the_cycle_says_so() -> None:
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
