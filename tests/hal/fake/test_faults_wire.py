"""Every fault does on the wire what its word says."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
import pytest

from hal.errors import DeviceMissing
from hal.fake.answers import State
from hal.fake.faults import FaultError
from hal.fake.lidar_faults import LIDAR
from hal.fake.models import URG_04LX, UTM_30LX, Unit
from tests.hal.fake.bench import Reply, Talk, read, summed, virtual

T = TypeVar("T")

PERIOD = UTM_30LX.true_period_s
MD = "MD0000108000000"
FRAME = 3372
COVERED: set[str] = set()


def order(what: str, **values: object) -> str:
    COVERED.add(what)
    lines = [f"{key} = {value!r}".replace("True", "true") for key, value in values.items()]
    return "\n".join(["[[fault]]", f"what = '{what}'", *lines])


def pieces(toml: str, seconds: float = 1.0, command: str = MD) -> list[bytes]:
    """What arrives write by write (whole replies, unless the fault says otherwise), acknowledgement first."""

    async def scene(talk: Talk) -> list[bytes]:
        talk.schedule.load(toml)
        talk.say(command + "\n")
        await asyncio.sleep(seconds)
        return [data for _, data in talk.pieces]

    return virtual(scene)


def sound(data: bytes) -> bool:
    try:
        reply = read(data)
        return len(reply.values()) == 1081 and summed(reply.lines[0]) != ""
    except (AssertionError, UnicodeDecodeError, ValueError):
        return False


def differing(one: bytes, other: bytes) -> list[int]:
    assert len(one) == len(other)
    return [i for i, (a, b) in enumerate(zip(one, other, strict=True)) if a != b]


@pytest.fixture(scope="module")
def clean() -> list[bytes]:
    return pieces("")


PARTS = {
    "echo": lambda i: i < 15,
    "status": lambda i: 16 <= i < 18,
    "stamp": lambda i: 20 <= i < 24,
    "data": lambda i: i >= 26 and (i - 26) % 66 < 64,
    "sum": lambda i: i >= 26 and ((i - 26) % 66 == 64 or i == FRAME - 3),
}


@pytest.mark.parametrize("part", PARTS)
def test_bit_flip(clean: list[bytes], part: str) -> None:
    got = pieces(order("bit_flip", part=part, every=2))
    hit = {n: differing(a, b) for n, (a, b) in enumerate(zip(clean, got, strict=True)) if a != b}
    assert list(hit) == list(range(2, len(got), 2))
    for n, at in hit.items():
        assert len(at) == 1
        assert PARTS[part](at[0]), at
        assert (clean[n][at[0]] ^ got[n][at[0]]).bit_count() == 1
        assert part in ("echo", "status") or not sound(got[n]) or clean[n][at[0]] ^ got[n][at[0]] >= 0x40


def test_bit_flip_of_a_chosen_bit_in_a_text_reply() -> None:
    plain = pieces("", command="VV")[0]
    (got,) = pieces(order("bit_flip", on="replies", bit=0, count=1), command="VV")
    (at,) = differing(plain, got)
    assert plain[at] ^ got[at] == 1
    assert at > len("VV\n00P\n")


def test_drop_byte(clean: list[bytes]) -> None:
    got = pieces(order("drop_byte", count=3))
    assert [len(data) for data in got[:6]] == [21, FRAME - 1, FRAME - 1, FRAME - 1, FRAME, FRAME]
    assert got[4:] == clean[4:]


def test_drop_line_and_duplicate_line(clean: list[bytes]) -> None:
    for what, change in (("drop_line", -1), ("duplicate_line", 1)):
        got = pieces(order(what, count=1))[1]
        before, after = Counter(clean[1].split(b"\n")), Counter(got.split(b"\n"))
        (line,) = (before - after) if change < 0 else (after - before)
        assert len(line) in (65, (FRAME - 27) % 66)
        assert len(got) - len(clean[1]) == change * (len(line) + 1)
        assert not sound(got)


def test_cut_frame(clean: list[bytes]) -> None:
    got = pieces(order("cut_frame", count=1))
    assert clean[1].startswith(got[1])
    assert 0 < len(got[1]) < FRAME - 1
    assert got[2] == clean[2]


def test_alien_reply(clean: list[bytes]) -> None:
    got = pieces(order("alien_reply", count=1, command="PP"))[1]
    alien = b"PP\n00P\nMODL:UTM-30LX"
    at = got.index(alien)
    end = got.index(b"\n\n", at) + 2
    assert got[:at] + got[end:] == clean[1]


@pytest.mark.parametrize("code", [21, 50, 98])
def test_status(code: int) -> None:
    got = [read(data) for data in pieces(order("status", code=code, count=2))]
    assert [reply.status for reply in got[:5]] == ["00", f"{code:02d}", f"{code:02d}", "99", "99"]
    assert got[1].echo == MD
    assert got[1].lines == []


def ticks(toml: str) -> list[int]:
    return [read(data).tick for data in pieces(toml)[1:]]


def test_frozen_stamp() -> None:
    got = [read(data) for data in pieces(order("frozen_stamp", when=0.2, **{"for": 0.3}))[1:]]
    steps = np.diff([reply.tick for reply in got])
    assert list(steps).count(0) in (11, 12)
    assert steps.max() > 270  # afterwards the true stamps again
    values = [reply.values()[0] for reply in got]
    assert np.all(np.diff(values) == 2)


@pytest.mark.parametrize("by_ms", [-5000, 40000])
def test_stamp_jump(by_ms: int) -> None:
    plain = ticks("")
    got = ticks(order("stamp_jump", by_ms=by_ms, count=1))
    assert got[0] == (plain[0] + by_ms) % (1 << 24)
    assert got[1:] == plain[1:]


def test_set_clock() -> None:
    got = ticks(order("set_clock", when=0.5))
    jump = int(np.argmax(np.abs(np.diff(got))))
    assert 0.4 < jump * PERIOD < 0.6
    assert got[jump + 1] > 16_776_000 - 30
    assert got[-1] < 16_776_000 + 600


def test_stuck() -> None:
    got = pieces(order("stuck", when=0.2, **{"for": 0.3}))[1:]
    same = sum(a == b for a, b in pairwise(got))
    assert same in (11, 12)
    assert all(sound(data) for data in got)


@pytest.mark.parametrize("by", [-1, 1, 7])
def test_wrong_steps(by: int) -> None:
    got = [read(data) for data in pieces(order("wrong_steps", by=by, count=1))[1:]]
    assert [len(reply.values()) for reply in got[:3]] == [1081 + by, 1081, 1081]


@pytest.mark.parametrize("value", [*range(20), 65533])
def test_codes(value: int) -> None:
    reply = read(pieces(order("codes", value=value, beams=0.5, count=1), 0.2)[1])
    values = np.array(reply.values())
    hit = values == value
    assert 450 < hit.sum() < 630
    assert np.all(values[~hit] == (1000 + np.arange(1081))[~hit])


def test_wrong() -> None:
    first, second = (read(data).values() for data in pieces(order("wrong", by_mm=-300, count=1))[1:3])
    assert first == [700 + step for step in range(1081)]
    assert second == [1002 + step for step in range(1081)]


def test_dark() -> None:
    dark, light = (read(data).values()[1::2] for data in pieces(order("dark", count=1), command="ME" + MD[2:])[1:3])
    assert set(dark) == {0}
    assert light == [300 + step for step in range(1081)]


def test_garbage(clean: list[bytes]) -> None:
    got = pieces(order("garbage", count=2))
    assert [len(data) for data in got[1:3]] == [FRAME, FRAME]
    assert all(len(set(data)) == 256 for data in got[1:3])
    assert got[3:] == clean[3:]


def test_intermittent(clean: list[bytes]) -> None:
    got = pieces(order("intermittent"))
    assert 0.2 * len(clean) < len(got) < 0.8 * len(clean)
    assert set(got) <= set(clean)


def arrivals(toml: str, seconds: float = 3.0) -> tuple[list[float], list[int]]:
    async def scene(talk: Talk) -> tuple[list[float], list[int]]:
        talk.schedule.load(toml)
        talk.say(MD + "\n")
        await asyncio.sleep(seconds)
        scans = talk.scans()
        return [scan.t for scan in scans], [scan.tick for scan in scans]

    return virtual(scene)


def test_slow() -> None:
    times, stamps = arrivals(order("slow", factor=3.0, when=1.0, **{"for": 1.0}))
    assert np.allclose(1e3 * np.diff(times), np.diff(stamps), atol=1.5 + 1e3 * PERIOD * 2)
    gaps = np.diff(stamps)
    assert set(np.round(gaps / (1e3 * PERIOD)).astype(int)) == {1, 3}
    assert np.sum(gaps > 70) in (12, 13, 14)


def test_delayed() -> None:
    times, stamps = arrivals(order("delayed", by_s=0.5, when=1.0, **{"for": 1.0}))
    late = np.array(times) - np.array(stamps) * 1e-3
    assert np.all(np.diff(times) >= 0.0)
    assert late[:30] == pytest.approx(0.0222, abs=1.1e-3)
    assert late[45:70] == pytest.approx(0.5222, abs=1.1e-3)
    assert late[-5:] == pytest.approx(0.0222, abs=1.1e-3)
    assert len(times) == 118  # none lost


def test_silence() -> None:
    times, _ = arrivals(order("silence", when=1.0, **{"for": 1.0}))
    assert np.max(np.diff(times)) == pytest.approx(1.0, abs=2 * PERIOD)
    assert len(times) == pytest.approx(80, abs=2)


def test_stall_and_burst() -> None:
    times, stamps = arrivals(order("stall", when=0.5, **{"for": 2.0}))
    assert np.sum(np.array(times) == 2.5) == pytest.approx(80, abs=1)
    assert np.all(np.abs(np.diff(stamps) - 1e3 * PERIOD) < 1)  # nothing is lost


@pytest.mark.parametrize("size", [1, 64, 4096])
def test_pieces(clean: list[bytes], size: int) -> None:
    got = pieces(order("chunks", piece=size), 0.2)
    assert max(map(len, got)) == min(size, FRAME)
    whole = b"".join(got)
    assert whole == b"".join(clean)[: len(whole)]


def test_the_last_line_feed_apart() -> None:
    async def scene(talk: Talk) -> list[tuple[float, bytes]]:
        talk.schedule.load(order("chunks", piece=0, split_end=True))
        talk.say(MD + "\n")
        await asyncio.sleep(0.2)
        return talk.pieces

    got = virtual(scene)
    assert {data for _, data in got[1::2]} == {b"\n"}
    assert all(data.endswith(b"\n") and b"\n\n" not in data for _, data in got[::2])
    assert all(b[0] > a[0] for a, b in zip(got[::2], got[1::2], strict=False))


def test_three_scans_in_one_write(clean: list[bytes]) -> None:
    got = pieces(order("chunks", piece=0, join=3))
    assert got[1] == b"".join(clean[1:4])
    assert {len(data) for data in got[1:]} == {3 * FRAME}
    assert len(got) == 13


def test_ignore_counts() -> None:
    async def scene(talk: Talk) -> list[int]:
        talk.schedule.load(order("ignore", command="QT", count=2))
        await talk.ask(MD, 0.1)
        heard = []
        for _ in range(3):
            replies = await talk.ask("QT", 0.2)
            heard.append(sum(reply.echo == "QT" for reply in replies))
        assert talk.device.state is State.IDLE
        return heard

    assert virtual(scene) == [0, 0, 1]


def test_acknowledgement_lost() -> None:
    got = [read(data).status for data in pieces(order("no_reply", command="MD", count=1))]
    assert set(got) == {"99"}
    assert len(got) > 30


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


def test_every_word_was_tried() -> None:
    assert set(LIDAR) == COVERED, "run the whole file"
