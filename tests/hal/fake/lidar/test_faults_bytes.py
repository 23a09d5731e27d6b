"""Faults in the bytes and values of a scan do on the wire what their words say."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from tests.hal.fake.bench import read
from tests.hal.fake.wire import FRAME, MD, PERIOD, differing, order, pieces, sound


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
