"""The benchmark of latency: its C loop waits as long as it says, and its rows say what was measured."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hal.beside import beside
from tools.bench import _readers, latency

needs_cc = pytest.mark.skipif(shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler")


def told(late_us: float, loaded_us: float, missed: int = 0, quiet: float = 0.12) -> dict[str, Any]:
    return {
        "late": {"quiet": [late_us] * 1000, "alone": [late_us] * 1000, "loaded": [loaded_us] * 1000},
        "cycle": {"quiet": [2900.0] * 1000, "alone": [3000.0] * 1000, "loaded": [3500.0] * 1000},
        "share": {"quiet": [quiet], "alone": [0.2], "loaded": [0.3]},
        "missed": missed, "scans": 2000, "solved": 9, "stalls": 0, "asked": 800, "answered": 799, "bare": [50.0] * 400,
    }  # fmt: skip


@needs_cc
def test_the_loop_in_c_is_never_early_and_tells_every_turn(tmp_path: Path) -> None:
    late = latency.bare(latency.compiled(tmp_path), fifo=False, seconds=0.5)
    assert len(late) == 20
    assert min(late) >= 0.0


def test_rows_are_judged_with_real_time_rights_only() -> None:
    rows = latency.figures({"SCHED_FIFO": told(400.0, 700.0), "ordinary": told(4000.0, 90_000.0)})
    by_name = {row.name: row for row in rows}
    assert by_name["SCHED_FIFO: p99, loaded over alone"].value == pytest.approx(0.3)
    assert by_name["SCHED_FIFO: p99.9 of all cycles over the bare loop's"].value == pytest.approx(0.65)
    assert by_name["SCHED_FIFO: cycles, alone: late, p99"].value == pytest.approx(0.4)
    assert by_name["SCHED_FIFO: all threads, share of one core, quiet"].value == pytest.approx(12.0)
    assert by_name["ordinary: Modbus requests unanswered"].value == 1.0
    assert not any(row.ok is False for row in rows if row.name.startswith("SCHED_FIFO"))


def test_what_is_missed_shows() -> None:
    rows = latency.figures({"SCHED_FIFO": told(2000.0, 9000.0, missed=3, quiet=0.16)})
    missed = {row.name.removeprefix("SCHED_FIFO: ") for row in rows if row.ok is False}
    assert missed == {
        "cycles, alone: late, p99", "p99.9 of all cycles over the bare loop's",
        "p99, loaded over alone", "scans missed", "all threads, share of one core, quiet",
    }  # fmt: skip


class Echo(asyncio.DatagramProtocol):
    """Answers every request, with as many bytes as the daemon; tells at which it is."""

    def __init__(self, on_request: Callable[[int], None]) -> None:
        self.requests = 0
        self._on_request = on_request

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport: Any = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self.requests += 1
        self._transport.sendto(bytes(9 + 2 * _readers.REGISTERS), addr)
        self._on_request(self.requests)


async def echoing(on_request: Callable[[int], None]) -> tuple[asyncio.DatagramTransport, Echo, int]:
    made = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: Echo(on_request), local_addr=("127.0.0.1", 0)
    )
    return *made, int(made[0].get_extra_info("sockname")[1])


def test_readers_that_are_told_to_end_ask_no_more() -> None:
    """In the middle of a round."""
    last = 2 * _readers.CLIENTS + 2

    def end(number: int) -> None:
        if number == last:
            os.kill(os.getpid(), signal.SIGTERM)

    async def run() -> tuple[int, int]:
        transport, _, port = await echoing(end)
        counts = await asyncio.wait_for(_readers.go(port), 20.0)
        transport.close()
        await asyncio.sleep(0)
        return counts

    asked, answered = asyncio.run(run())
    assert asked == answered
    assert last <= asked <= last + 2


def test_the_load_asks_only_while_it_is_served(tmp_path: Path) -> None:
    path = str(tmp_path / "stream")

    async def run() -> tuple[tuple[int, int], int]:
        asked = asyncio.Event()
        transport, echo, port = await echoing(lambda number: asked.set())
        server = await asyncio.start_unix_server(lambda reader, writer: writer.close(), path)
        load = latency.Load(port, path)
        load.turn(True)
        await asyncio.wait_for(asked.wait(), 20.0)
        counts = await beside(load.end, "end")
        transport.close()
        server.close()
        await server.wait_closed()
        return counts, echo.requests

    (asked, answered), requests = asyncio.run(run())
    assert asked == answered == requests > 0
