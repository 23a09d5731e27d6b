"""The benchmark of taps that hang: they are there, they take nothing, and they are gone at once."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
from pathlib import Path

from tests.daemon.publish.stream.test_server import serve, until
from tests.tools.bench.system.test_viewers import told
from tools.bench.support.children import ROOT
from tools.bench.system.stalled import TAPS, Taps, figures

STARTS = (
    "import sys, time; from tools.bench.system.stalled import Taps; t = Taps(sys.argv[1]); t.turn(True); time.sleep(60)"
)


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


def test_taps_do_not_outlive_a_benchmark_that_is_killed(tmp_path: Path) -> None:
    """They would keep their connections, and wait for ever."""
    with socket.socket(socket.AF_UNIX) as stream:
        stream.bind(str(tmp_path / "s"))
        stream.listen(TAPS)
        stream.settimeout(60.0)
        with subprocess.Popen([sys.executable, "-c", STARTS, str(tmp_path / "s")], cwd=ROOT) as benchmark:
            try:
                tap = stream.accept()[0]
            finally:
                benchmark.kill()
        with tap:
            tap.settimeout(10.0)
            while tap.recv(1 << 16):
                pass
