"""The benchmark of watching browsers: what it says of what was measured, and its helpers, without a daemon."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from taps.view import server
from tests.daemon.publish.stream.test_server import serve, until
from tests.taps.view.house import snapshot
from tools.bench.support.drive import PERIOD_S
from tools.bench.support.paced import SETTLE_S, Feeder, Wanted
from tools.bench.system import viewers


def told(late_us: float, watched_us: float) -> dict[str, Any]:
    return {
        "late": {"alone": [late_us] * 1000, "loaded": [watched_us] * 1000},
        "cycle": {"alone": [3000.0] * 1000, "loaded": [3100.0] * 1000},
        "pair": {stretch: [number // 500 for number in range(1000)] for stretch in ("alone", "loaded")},
        "missed": 0, "messages": 20_000, "size": 4_000_000,
    }  # fmt: skip


def test_rows_say_what_watching_costs() -> None:
    rows = {row.name: row for row in viewers.figures(told(100.0, 400.0), 2)}
    more = rows["cycles begin late, p99, watched over alone"]
    assert (more.value, more.ok) == (pytest.approx(0.3), True)
    assert rows["messages a second to each browser"].value == pytest.approx(50.0)
    assert not viewers.figures(told(100.0, 700.0), 2)[4].ok


def test_a_disturbance_of_one_pair_is_not_the_browsers() -> None:
    """Both of a pair have it, or one of them alone: the middle of the pairs stays what watching costs."""
    found = told(100.0, 400.0)
    for stretch in ("alone", "loaded"):
        found["pair"][stretch] = [number // 200 for number in range(1000)]
        found["late"][stretch][:200] = [value + 5000.0 for value in found["late"][stretch][:200]]
    found["late"]["loaded"][200:400] = 200 * [9000.0]
    assert viewers.by_pair(found, "late") == pytest.approx([0.3, 8.9, 0.3, 0.3, 0.3])
    rows = {row.name: row for row in viewers.figures(found, 2)}
    middle = rows["cycles begin late, p99, watched over alone, of 5 pairs, median"]
    assert (middle.value, middle.ok) == (pytest.approx(0.3), True)
    assert rows["cycles begin late, p99, watched over alone"].ok is False


def test_browsers_that_are_told_nothing_prove_nothing() -> None:
    rows = {row.name: row for row in viewers.figures(told(100.0, 100.0) | {"messages": 100}, 2)}
    assert rows["messages a second to each browser"].ok is False


def test_stretches_come_in_pairs_of_which_every_other_is_the_other_way_round() -> None:
    wanted = Wanted("", "", 0, "", False, turns=2, stretch_s=10.0)
    feeder, order = Feeder(wanted, None, []), []  # type: ignore[arg-type]  # it is not run
    for number in range(round((SETTLE_S + 40.0) / PERIOD_S)):
        feeder._number = number
        if feeder._stretch_now():
            order.append((int(feeder._at()) // 2, feeder._stretch_now()))
    assert list(dict.fromkeys(order)) == [(0, "alone"), (0, "loaded"), (1, "loaded"), (1, "alone")]
    assert len(order) == round(40.0 / PERIOD_S)


@pytest.mark.system
def test_browsers_come_and_go(tmp_path: Path) -> None:
    async def body() -> None:
        stream = serve(tmp_path / "stream")
        serving = asyncio.create_task(stream.run())
        await until(stream.path.is_socket)
        page = await asyncio.to_thread(viewers.Page, str(stream.path))
        try:
            page.turn(True)
            async with asyncio.timeout(30.0):
                await until(lambda: stream.wanted("pose"))
                for number in range(60):
                    stream.publish(snapshot(number))
                    await asyncio.sleep(server.PACE_S)
                page.turn(False)
                await until(lambda: not stream.clients)
            messages, size = await asyncio.to_thread(page.end)
            assert messages >= viewers.BROWSERS
            assert size > 200 * messages
        finally:
            page.kill()
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(body())
