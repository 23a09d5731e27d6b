"""The benchmark of taps that hang: they are there, they take nothing, and they are gone at once."""

from __future__ import annotations

import asyncio
from pathlib import Path

from tests.daemon.publish.test_stream import serve, until
from tests.tools.test_bench_viewers import told
from tools.bench.stalled import TAPS, Taps, figures


def test_rows_say_what_hanging_taps_cost() -> None:
    rows = {row.name: row for row in figures(told(100.0, 700.0))}
    assert rows["cycles begin late, p99, stalled over alone"].ok is False
    assert rows["a cycle takes, p99, stalled over alone"].ok is True
    assert rows["cycles, alone and stalled"].value == 2000.0


def test_taps_come_hang_and_go(tmp_path: Path) -> None:
    async def body() -> None:
        server = serve(tmp_path / "s")
        serving = asyncio.create_task(server.run())
        await until(server.path.is_socket)
        taps = Taps(str(server.path))
        try:
            taps.turn(True)
            await until(lambda: len(server.clients) == TAPS and all("raw" in one.wants for one in server.clients))
            for _ in range(2000):
                server.on_raw("lidar", "rx", 1.0, bytes(1000))
                await asyncio.sleep(0)
            assert all(client.stuck for client in server.clients)
            taps.turn(False)
            await until(lambda: not server.clients)
        finally:
            taps.kill()
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(body())
