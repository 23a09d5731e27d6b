"""Faults of the sensor's states, texts and line do on the wire what their words say."""

from __future__ import annotations

import asyncio

import pytest

from hal.fake.faults.orders import FaultError
from hal.fake.lidar.faults import LIDAR
from tests.hal.fake.bench import Talk, read, virtual
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


def test_baud_is_refused_where_there_is_no_line_rate() -> None:
    async def scene(talk: Talk) -> None:
        with pytest.raises(FaultError, match="no line rate"):
            talk.schedule.load(order("baud"))

    virtual(scene)


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
