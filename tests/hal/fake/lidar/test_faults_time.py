"""Faults in time and in the order of replies do on the wire what their words say."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from tests.hal.fake.bench import Talk, virtual
from tests.hal.fake.wire import FRAME, MD, PERIOD, order, pieces


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
