"""The benchmark of watching browsers: what it says of what was measured, and its helpers, without a daemon."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from taps.view import server
from tests.daemon.publish.test_stream import serve, until
from tests.taps.view.house import snapshot
from tools.bench import viewers


def told(late_us: float, watched_us: float) -> dict[str, Any]:
    return {
        "late": {"alone": [late_us] * 1000, "loaded": [watched_us] * 1000},
        "cycle": {"alone": [3000.0] * 1000, "loaded": [3100.0] * 1000},
        "missed": 0, "messages": 20_000, "size": 4_000_000,
    }  # fmt: skip


def test_rows_say_what_watching_costs() -> None:
    rows = {row.name: row for row in viewers.figures(told(100.0, 400.0), 2)}
    more = rows["cycles begin late, p99, watched over alone"]
    assert (more.value, more.ok) == (pytest.approx(0.3), True)
    assert rows["messages a second to each browser"].value == pytest.approx(50.0)
    assert not viewers.figures(told(100.0, 700.0), 2)[4].ok


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
