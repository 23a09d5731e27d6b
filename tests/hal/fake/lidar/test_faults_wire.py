"""Faults of the sensor's states, texts and line do on the wire what their words say."""

from __future__ import annotations

import ast
import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.errors import DeviceMissing
from hal.fake.faults.orders import FaultError
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.models import URG_04LX, UTM_30LX, Unit
from tests.hal.fake.bench import Reply, Talk, read, virtual
from tests.hal.fake.wire import MD, order, pieces, sound


def text(toml: str, command: str) -> bytes:
    return pieces(toml, 0.2, command)[0]


def test_text_sums() -> None:
    plain = text("", "II").split(b"\n")
    whole = text(order("text_sum", variant="whole"), "II").split(b"\n")
    mark = text(order("text_sum", variant="mark"), "II").split(b"\n")
    bodies = [line[:-1] for line in plain]
    assert [line[:-1] for line in mark] == bodies
    for line in whole[2:-2]:
        assert line[-1] == sum(line[:-1]) % 64 + 48
    for before, after in zip(plain, mark, strict=True):
        if b"<-" in after:
            assert after[-1] == sum(after[: after.index(b"<-") + 2]) % 64 + 48
        else:
            assert after == before
    assert any(b"<-" in line for line in mark)


def test_semicolon_in_a_value() -> None:
    assert read(text(order("semicolon"), "VV")).pairs["FIRM"] == "P.1.05(17/Apr./2009);beta"


def test_dmax() -> None:
    assert read(text(order("dmax"), "PP")).pairs["DMAX"] == "262143"


def test_trouble() -> None:
    assert read(text(order("trouble"), "II")).pairs["STAT"] == "Trouble!! Error No. =[00->33]"


def test_modem_manager() -> None:
    async def scene(talk: Talk) -> list[str]:
        talk.schedule.load(order("inject", when=0.1))
        await talk.ask(MD, 0.5)
        return [reply.echo + reply.status for reply in talk.replies()]

    replies = virtual(scene)
    assert replies.count("AT0E") == 1
    assert replies.count(MD + "99") == 19


def test_scip1() -> None:
    async def scene(talk: Talk) -> list[bytes]:
        heard = []
        talk.schedule.load(order("scip1"))
        await asyncio.sleep(0.1)
        for line in ("QT", "SCIP2.0", "VV"):
            talk.pieces.clear()
            talk.say(line + "\n")
            await asyncio.sleep(0.1)
            heard.append(talk.raw[:7])
        return heard

    assert virtual(scene) == [b"QT\nE\n\n", b"SCIP2.0", b"VV\n00P\n"]


def test_wrong_baud_rate() -> None:
    async def scene(talk: Talk) -> tuple[bytes, str]:
        talk.schedule.load(order("baud", rate=115200))
        await asyncio.sleep(0.1)
        talk.say("VV\n")
        await asyncio.sleep(1.0)
        silent = talk.raw
        assert talk.port is not None
        talk.port.set_baud(115200)
        return silent, await talk.status("VV")

    assert virtual(scene, URG_04LX) == (b"", "00")


def test_baud_is_refused_where_there_is_no_line_rate() -> None:
    async def scene(talk: Talk) -> None:
        with pytest.raises(FaultError, match="no line rate"):
            talk.schedule.load(order("baud"))

    virtual(scene)


async def gone(talk: Talk) -> bool:
    try:
        await talk.open()
    except DeviceMissing:
        return True
    return False


def test_hangup_keeps_the_sensor_running() -> None:
    async def scene(talk: Talk) -> tuple[bool, bool, list[Reply]]:
        talk.schedule.load(order("hangup", when=0.2, **{"for": 1.0}))
        talk.say(MD + "\n")
        await asyncio.sleep(0.5)
        assert talk.lost is not None
        talk.pieces.clear()
        early = await gone(talk)
        await asyncio.sleep(1.0)
        late = await gone(talk)
        await asyncio.sleep(0.2)
        return early, late, talk.replies()

    early, late, replies = virtual(scene)
    assert (early, late) == (True, False)
    assert replies[0].status == "99"  # a USB sensor does not notice and goes on
    assert replies[0].tick > 1400


@pytest.mark.parametrize("link", ["usb", "rs232"])
def test_off_and_on_again(link: str) -> None:
    async def scene(talk: Talk) -> tuple[bool, bool, Reply, State]:
        talk.schedule.load(order("off", when=1.0, **{"for": 2.0}))
        talk.say(MD + "\n")
        await asyncio.sleep(2.0)
        lost, missing = talk.lost is not None, (await gone(talk) if link == "usb" else False)
        talk.pieces.clear()
        talk.say("VV\n") if link == "rs232" else None
        await asyncio.sleep(2.5)
        assert talk.raw == b""
        if link == "usb":
            await talk.open()
        state = talk.device.state
        return lost, missing, await talk.one("TM1"), state

    lost, missing, stamp, state = virtual(scene, replace(UTM_30LX, link=link), unit=Unit(clock_ms=5_000_000))  # type: ignore[arg-type]  # a str of the three
    assert lost is missing is (link == "usb")
    assert state is State.IDLE
    assert 1400 < stamp.tick < 2500


def test_reset_keeps_the_connection() -> None:
    async def scene(talk: Talk) -> Reply:
        talk.schedule.load(order("reset", when=1.0))
        talk.say(MD + "\n")
        await asyncio.sleep(3.0)
        assert talk.lost is None
        talk.pieces.clear()
        await asyncio.sleep(1.0)
        assert talk.raw == b""
        return await talk.one("TM1")

    assert virtual(scene, unit=Unit(clock_ms=9_000_000)).tick == pytest.approx(3001, abs=2)


def test_boot_delay() -> None:
    async def scene(talk: Talk) -> list[State]:
        talk.schedule.load(order("boot_delay", by_s=5.0) + "\n" + order("reset", when=0.1))
        states = []
        for _ in range(2):
            await asyncio.sleep(5.5)
            states.append(talk.device.state)
        return states

    assert virtual(scene) == [State.BOOTING, State.IDLE]


def test_error() -> None:
    async def scene(talk: Talk) -> list[tuple[str, str]]:
        talk.schedule.load(order("error", code=61, when=0.2))
        await talk.ask(MD, 0.5)
        last = talk.replies()[-1]
        out = [(last.echo, last.status)]
        out += [(line, await talk.status(line)) for line in ("QT", MD, "RS", "VV", "RB")]
        return out

    assert virtual(scene) == [(MD, "61"), ("QT", "0L"), (MD, "0L"), ("RS", "0L"), ("VV", "00"), ("RB", "01")]


def test_verify() -> None:
    async def scene(talk: Talk) -> list[Reply]:
        talk.schedule.load(order("verify", when=0.2, **{"for": 1.0}))
        await talk.ask(MD, 2.0)
        return talk.replies()

    got = virtual(scene)
    at = [reply.status for reply in got].index("21")
    assert got[at + 1].status == "98"
    assert got[at + 1].t - got[at].t == pytest.approx(1.0)
    assert {reply.status for reply in got[1:at] + got[at + 2 :]} == {"99"}
    assert len(got) > 35


def test_the_same_ordered_twice_ends_with_the_last() -> None:
    twice = order("off", when=1.0, **{"for": 1.0}) + "\n" + order("off", when=1.5, **{"for": 2.0})
    twice += "\n" + order("reset", when=2.5)  # no effect without power
    twice += "\n" + order("slow", factor=4.0, when=6.0) + "\n" + order("slow", factor=2.0, when=6.0, **{"for": 0.5})

    async def scene(talk: Talk) -> tuple[list[bool], int]:
        talk.schedule.load(twice)
        seen = []
        for _ in range(6):
            await asyncio.sleep(0.9)
            seen.append(talk.device.reachable)
        await asyncio.sleep(1.6)
        await talk.open()
        return seen, int(np.diff([scan.tick for scan in (await talk.ask(MD, 1.0))[1:]]).mean())

    seen, step = virtual(scene)
    assert seen == [True, False, False, False, True, True]
    assert step == pytest.approx(100, abs=1)


@pytest.mark.parametrize("what", sorted(LIDAR))
def test_lifted_faults_leave_a_sound_stream(what: str) -> None:
    """However a fault ends, a sensor that is opened and asked again streams as before."""

    async def scene(talk: Talk) -> int:
        if what == "baud":
            return 0
        talk.say(MD + "\n")
        await asyncio.sleep(0.1)
        talk.schedule.load(order(what, when=0.1))
        await asyncio.sleep(1.0)
        talk.schedule.clear()
        await asyncio.sleep(4.0)
        if talk.lost is not None:
            await talk.open()
        for line in ("SCIP2.0", "RB", "RB"):
            talk.say(line + "\n")
            await asyncio.sleep(0.2)
        await asyncio.sleep(5.0)
        await talk.open()
        talk.pieces.clear()
        talk.say(MD + "\n")
        await asyncio.sleep(1.0)
        assert talk.lost is None
        return sum(sound(data) for _, data in talk.pieces)

    assert virtual(scene) >= (0 if what == "baud" else 38)


def words_named() -> set[str]:
    """Every text of the tests of faults on the wire; `test_lifted_faults_leave_a_sound_stream` names none."""
    trees = [ast.parse(path.read_text()) for path in Path(__file__).parent.glob("test_faults_*.py")]
    return {str(node.value) for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)}


def test_every_word_has_a_test_of_its_own() -> None:
    assert set(LIDAR) - words_named() == set()
