"""Faults of the fake lidar do on the wire what their words say: states, texts, bytes, values, times."""

import asyncio

import numpy as np
import pytest

from hal.fake.faults.orders import FaultError
from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.models import UTM_30LX
from tests.hal.fake.bench import Talk, read, summed, talking, virtual


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


@talking()
async def test_modem_manager(talk: Talk) -> None:
    talk.schedule.load(order("inject", when=0.1))
    await talk.ask(MD, 0.5)
    replies = [reply.echo + reply.status for reply in talk.replies()]
    assert replies.count("AT0E") == 1
    assert replies.count(MD + "99") == 19


@talking()
async def test_baud_is_refused_where_there_is_no_line_rate(talk: Talk) -> None:
    with pytest.raises(FaultError, match="no line rate"):
        talk.schedule.load(order("baud"))


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


def test_wrong() -> None:
    first, second = (read(data).values() for data in pieces(order("wrong", by_mm=-300, count=1))[1:3])
    assert first == [700 + step for step in range(1081)]
    assert second == [1002 + step for step in range(1081)]


def test_dark() -> None:
    dark, light = (read(data).values()[1::2] for data in pieces(order("dark", count=1), command="ME" + MD[2:])[1:3])
    assert set(dark) == {0}
    assert light == [300 + step for step in range(1081)]


@pytest.fixture(scope="module")
def clean() -> list[bytes]:
    return pieces("")


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


@pytest.mark.parametrize("size", [1, 64, 4096])
def test_pieces(clean: list[bytes], size: int) -> None:
    got = pieces(order("chunks", piece=size), 0.2)
    assert max(map(len, got)) == min(size, FRAME)
    whole = b"".join(got)
    assert whole == b"".join(clean)[: len(whole)]


@talking()
async def test_the_last_line_feed_apart(talk: Talk) -> None:
    talk.schedule.load(order("chunks", piece=0, split_end=True))
    talk.say(MD + "\n")
    await asyncio.sleep(0.2)
    got = talk.pieces
    assert {data for _, data in got[1::2]} == {b"\n"}
    assert all(data.endswith(b"\n") and b"\n\n" not in data for _, data in got[::2])
    assert all(b[0] > a[0] for a, b in zip(got[::2], got[1::2], strict=False))


def test_three_scans_in_one_write(clean: list[bytes]) -> None:
    got = pieces(order("chunks", piece=0, join=3))
    assert got[1] == b"".join(clean[1:4])
    assert {len(data) for data in got[1:]} == {3 * FRAME}
    assert len(got) == 13


PERIOD = UTM_30LX.true_period_s


MD = "MD0000108000000"


FRAME = 3372


def order(what: str, **values: object) -> str:
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
