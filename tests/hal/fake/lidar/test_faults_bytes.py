"""Faults in the bytes and values of a scan do on the wire what their words say."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from tests.hal.fake.bench import read
from tests.hal.fake.wire import MD, PERIOD, order, pieces, sound


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
