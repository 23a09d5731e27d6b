"""States of the fake lidar, and the world that it scans."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import UST_10LX, UTM_30LX, LidarModel, Unit
from hal.fake.lidar.scan_world import Room
from tests.hal.fake.bench import Talk, talking, virtual

UST = replace(UST_10LX, link="usb")  # so that the line can be opened while it starts

COLUMNS = ("BOOTING", "IDLE", "SINGLE", "MULTI", "TIME_ADJUST", "ERROR", "SLEEP")
#             BOOTING IDLE  SINGLE MULTI T_ADJ ERROR SLEEP, and the state it ends in where that is another one
TABLE_2_0 = """
VV            00      00    00     00    0E    00    -
PP            00      00    00     00    0E    00    -
II            00      00    00     00    0E    00    -
BM            10      00:SINGLE 02 02    0E    0L    -
QT            00      00    00:IDLE 00:IDLE 00 0L    -
RS            00      00    00:IDLE 00:IDLE 00:IDLE 0L -
RT            00      00    00:IDLE 00:IDLE 00:IDLE 0L -
TM0           10      00:TIME_ADJUST 00:TIME_ADJUST 0E 02 0L -
TM1           10      00    00     00    00    0L    -
TM2           10      03    10     10    00:IDLE 0L  -
MD0000108000000 10    00:MULTI 00:MULTI 00 0E  0L    -
MS0000108000000 10    00:MULTI 00:MULTI 00 0E  0L    -
GD0000108000  10      10    00     00    0E    0L    -
RB            01      01    01     01    01    01    -
TM7           01      01    01     01    01    01    -
%ST           0E      0E    0E     0E    0E    0E    -
XX            0E      0E    0E     0E    0E    0E    -
"""
TABLE_2_2 = """
VV            silent  00    00     00    00    00    00
PP            silent  00    00     00    00    00    00
II            silent  00    00     00    00    00    00
BM            10      00:SINGLE 02 02    10    0L    10
QT            00      00    00:IDLE 00:IDLE 10 0L    00:IDLE
RS            00      00    00:IDLE 00:IDLE 00:IDLE 0L 00:IDLE
RT            00      00    00:IDLE 00:IDLE 00:IDLE 0L 00:IDLE
TM0           10      00:TIME_ADJUST 00:TIME_ADJUST 10 02 0L 10
TM1           10      00    00     00    00    0L    10
TM2           10      03    10     10    00:IDLE 0L  10
MD0000108000000 10    00:MULTI 00:MULTI 00 10  0L    10
NE0000108000000 10    00:MULTI 00:MULTI 00 10  0L    10
GD0000108000  10      10    00     00    0E    0L    10
HE0000108000  10      10    00     00    0E    0L    10
RB            01      01    01     01    01    01    01
%ST           00      00    00     00    00    00    00
%SL           10      00:SLEEP 00:SLEEP 00:SLEEP 10 0L 00
XX            0E      0E    0E     0E    0E    0E    0E
"""

WAY = {
    "BOOTING": "",
    "IDLE": "",
    "SINGLE": "BM",
    "MULTI": "MD0000108000000",
    "TIME_ADJUST": "TM0",
    "ERROR": "error",
    "SLEEP": "%SL",
}


def cases() -> list[tuple[LidarModel, str, str, str]]:
    out = []
    for model, table in ((UTM_30LX, TABLE_2_0), (UST, TABLE_2_2)):
        for row in table.strip().splitlines():
            command, *cells = row.split()
            out += [(model, command, state, cell) for state, cell in zip(COLUMNS, cells, strict=True) if cell != "-"]
    return out


def name(case: tuple[LidarModel, str, str, str]) -> str:
    return f"{case[0].profile}-{case[1][:3]}-{case[2]}"


async def bring(talk: Talk, state: str) -> None:
    if state == "BOOTING":
        talk.schedule.load('[[fault]]\nwhat = "boot_delay"\nby_s = 100.0\n[[fault]]\nwhat = "reset"\nwhen = 0.1')
        await asyncio.sleep(0.2)
    elif state == "ERROR":
        talk.schedule.load('[[fault]]\nwhat = "error"')
        await asyncio.sleep(0.1)
    elif WAY[state]:
        await talk.ask(WAY[state], 0.2)
    assert talk.device.state is State[state]


@pytest.mark.parametrize("case", cases(), ids=name)
def test_command_in_state(case: tuple[LidarModel, str, str, str]) -> None:
    model, command, state, cell = case
    status, _, after = cell.partition(":")

    async def scene(talk: Talk) -> tuple[list[str], State]:
        await bring(talk, state)
        replies = await talk.ask(command)
        mine = [reply.status for reply in replies if reply.echo == command and reply.status != "99"]
        return mine, talk.device.state

    answers, ends_in = virtual(scene, model)
    assert answers == ([] if status == "silent" else [status])
    assert ends_in is State[after or state]


@pytest.mark.parametrize(("strict", "status"), [(True, "04"), (False, "00")])
def test_time_outside_time_adjust(strict: bool, status: str) -> None:
    assert virtual(lambda talk: talk.status("TM1"), unit=Unit(strict_time=strict)) == status


@talking(UST)
async def test_codes_of_the_state_query(talk: Talk) -> None:
    out = {}
    for state in COLUMNS:
        await bring(talk, state)
        (line,) = [reply.lines[0] for reply in await talk.ask("%ST") if reply.echo == "%ST"]
        out[state] = line[:3]
        talk.schedule.clear()
        talk.schedule.load('[[fault]]\nwhat = "reset"')
        await asyncio.sleep(3.0)
    codes = out
    assert codes == dict(zip(COLUMNS, ["001", "000", "003", "004", "002", "900", "005"], strict=True))


@talking()
async def test_reboot_needs_two_requests_within_a_second(talk: Talk) -> None:
    statuses = [await talk.status("RB")]
    await asyncio.sleep(1.0)
    statuses.append(await talk.status("RB"))  # too late: counts as a first one
    statuses += [reply.status for reply in await talk.ask("RB", 0.05)]
    await asyncio.sleep(1.1)
    assert talk.lost is not None
    assert not talk.device.reachable
    await asyncio.sleep(2.0)
    assert talk.device.reachable
    assert statuses == ["01", "01", "00"]


@talking(unit=Unit(clock_ms=1_000_000))
async def test_reboot_recovers_from_error_and_zeroes_the_clock(talk: Talk) -> None:
    await bring(talk, "ERROR")
    trouble = (await talk.one("II")).pairs
    assert trouble["STAT"] == "Trouble!! Error No. =[00->70]"
    await talk.ask("RB\nRB", 0.5)
    await asyncio.sleep(3.0)
    await talk.open()
    after = (await talk.one("II")).pairs
    assert after["STAT"] == "Sensor works well."
    assert int(after["TIME"], 16) < 3000


@talking(unit=Unit(booted=False))
async def test_start_up(talk: Talk) -> None:
    await asyncio.sleep(0.6)
    await talk.open()
    early = [reply.pairs["MESM"] for reply in await talk.ask("II", 0.2)]
    await asyncio.sleep(0.5)
    assert early == ["001 Booting"]
    assert [reply.pairs["MESM"] for reply in await talk.ask("II")] == ["IDLE"]


@talking(unit=Unit(scip1=True))
async def test_scip_1_until_switched(talk: Talk) -> None:
    talk.say("QT\nV\nSCIP2.0\nVV\nSCIP2.0\n")
    await asyncio.sleep(0.5)
    raw = talk.raw
    first, rest = raw.split(b"\n\n", 1)
    assert first == b"QT\nE"
    assert rest.startswith(b"V\n0\nVEND:Hokuyo Automatic Co.,Ltd.\n")
    assert b"\n\nSCIP2.0\n0\n\nVV\n00P\n" in rest
    assert rest.endswith(b"\n\nSCIP2.0\n0Ee\n\n")


@talking(unit=Unit(booted=False, spin_up_s=4.0))
async def test_no_scan_before_the_motor_turns(talk: Talk) -> None:
    await asyncio.sleep(1.1)
    await talk.open()
    talk.say("MD0000108000001\n")
    await asyncio.sleep(5.0)
    assert 4.0 < talk.scans()[0].t < 4.1


@pytest.mark.parametrize("link", ["usb", "rs232", "ethernet"])
def test_a_host_that_leaves(link: str) -> None:
    async def scene(talk: Talk) -> State:
        talk.say("MD0000108000000\n")
        await asyncio.sleep(0.2)
        assert talk.port is not None
        talk.port.close()
        await asyncio.sleep(0.2)
        await talk.open()
        return talk.device.state

    after = virtual(scene, replace(UTM_30LX, link=link))  # type: ignore[arg-type]  # a str of the three
    assert after is (State.IDLE if link == "ethernet" else State.MULTI)


def test_room_is_seen_as_it_is() -> None:
    """The back wall and the right-hand wall, as the sensor sees them from where it is."""
    room = Room(UTM_30LX, noise_mm=0.0)
    scan = room(0.0)
    x, y, heading = room.pose(np.array([540 / 1440 * UTM_30LX.true_period_s]))[0]
    assert heading == pytest.approx(np.pi / 2, abs=0.01)  # looking along +y
    ahead, right = scan.ranges_mm[540], scan.ranges_mm[540 - 360]
    assert ahead == pytest.approx(1e3 * (5.0 - y), abs=5)
    assert right == pytest.approx(1e3 * (7.0 - x), abs=5)
    assert room(15.0).ranges_mm[540] != ahead
    assert scan.ranges_mm.min() > 300
    assert np.array_equal(Room(UTM_30LX, seed=3)(1.0).ranges_mm, Room(UTM_30LX, seed=3)(1.0).ranges_mm)
