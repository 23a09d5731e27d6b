"""The block of the parts: places, and what is listed."""

from __future__ import annotations

import struct

from daemon.cli import status_table
from daemon.cli.reports.status import as_object
from daemon.health.faults import Fault
from daemon.publish import document
from daemon.publish.modbus import integrity_block, parts_block, registers
from daemon.publish.modbus.requests import BLOCKS
from daemon.snapshot import Condition, Part, Thread
from tests.daemon.publish.modbus.test_registers import snapshot

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
