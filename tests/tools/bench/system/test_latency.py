"""The benchmark of latency: its C loop waits as long as it says, and its rows say what was measured."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from hal.blocking_calls import run_in_thread
from tools.bench.support import children
from tools.bench.support import readers as support_readers
from tools.bench.system import latency

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
        self._transport.sendto(bytes(9 + 2 * support_readers.REGISTERS), addr)
        self._on_request(self.requests)


async def echoing(on_request: Callable[[int], None]) -> tuple[asyncio.DatagramTransport, Echo, int]:
    made = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: Echo(on_request), local_addr=("127.0.0.1", 0)
    )
    return *made, int(made[0].get_extra_info("sockname")[1])


def test_readers_that_are_told_to_end_ask_no_more() -> None:
    """In the middle of a round."""
    last = 2 * support_readers.CLIENTS + 2

    def end(number: int) -> None:
        if number == last:
            os.kill(os.getpid(), signal.SIGTERM)

    async def run() -> tuple[int, int]:
        transport, _, port = await echoing(end)
        counts = await asyncio.wait_for(support_readers.go(port), 20.0)
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
        with ExitStack() as undo:
            load = latency.Load(port, path, undo)
            load.turn(True)
            await asyncio.wait_for(asked.wait(), 20.0)
            counts = await run_in_thread(load.end, "end")
        transport.close()
        server.close()
        await server.wait_closed()
        return counts, echo.requests

    (asked, answered), requests = asyncio.run(run())
    assert asked == answered == requests > 0


HANGS = "import os, sys, time; open(sys.argv[1], 'a').write(f'{os.getpid()} '); "
"""What stands for a program: it writes its number down, and what follows."""


@pytest.fixture
def stands(tmp_path: Path) -> Iterator[Callable[[str], tuple[str, ...]]]:
    """Makes words that start a program of some Python; whatever becomes of it, none of them may stay."""
    numbers = tmp_path / "numbers"
    yield lambda code: (sys.executable, "-c", HANGS + code, str(numbers))
    end = time.monotonic() + 5.0
    while any(_lives(number) for number in numbers.read_text().split()):
        assert time.monotonic() < end, "it goes on"
        time.sleep(0.02)


def _lives(number: str) -> bool:
    try:
        return "Z" not in Path("/proc", number, "stat").read_text().rpartition(")")[2]
    except OSError:
        return False


def played(folder: Path, monkeypatch: pytest.MonkeyPatch, daemon: tuple[str, ...], readers: tuple[str, ...]) -> float:
    """Seconds that the daemon's part took until it could not run."""
    monkeypatch.setattr(latency, "DAEMON", daemon)
    monkeypatch.setattr(latency, "READERS", readers)
    monkeypatch.setattr(children, "SILENT_S", 1.0)
    monkeypatch.setattr(children, "END_S", 1.0)
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(dir="/tmp") as short, pytest.raises(latency.CannotRun) as reason:
        latency.paced(Path(short), folder / "drive", False, 1, lambda on: None)
    (folder / "said").write_text(str(reason.value))
    return time.monotonic() - begun


@pytest.mark.parametrize(
    ("daemon", "says"),
    [
        ("time.sleep(60)", "the daemon has said nothing for 1 s"),
        ("print('quiet', flush=True); time.sleep(60)", "the daemon has said nothing for 1 s"),
        ("print('told {}', flush=True); time.sleep(60)", "the daemon has not ended within 1 s"),
        ("print('ended', flush=True); time.sleep(60)", "the readers ended before their time, with code "),
        ("print('loaded', flush=True); time.sleep(60)", "the daemon's stream takes no client"),
        ("print('quiet')", "the daemon ended before its time"),
    ],
)
def test_a_daemon_that_hangs_is_said_and_nothing_of_it_stays(
    daemon: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stands: Callable[[str], tuple[str, ...]]
) -> None:
    seconds = played(tmp_path, monkeypatch, stands(daemon), stands("time.sleep(60)"))
    assert says in (tmp_path / "said").read_text()
    assert seconds < 10.0


def test_who_does_not_end_when_told_to_is_killed(
    monkeypatch: pytest.MonkeyPatch, stands: Callable[[str], tuple[str, ...]]
) -> None:
    monkeypatch.setattr(children, "END_S", 0.5)
    deaf = "import signal; signal.signal(15, signal.SIG_IGN); print('on', flush=True); time.sleep(60)"
    with children.child(*stands(deaf), hear=True) as readers:
        assert next(children.lines(readers, "the readers")) == "on"
        with pytest.raises(latency.CannotRun, match=r"the readers were told to end and have not within 0\.5 s"):
            children.two_counts(readers, "the readers")
        begun = time.monotonic()
    assert time.monotonic() - begun < 10.0, "it was waited for, not killed"


def test_a_program_that_does_not_end_is_killed_with_what_it_has_started(
    stands: Callable[[str], tuple[str, ...]],
) -> None:
    """As a compiler's parts, which would keep its output open."""
    part = stands("time.sleep(60)")
    words = stands(f"import subprocess; subprocess.run({part!r})")
    begun = time.monotonic()
    with pytest.raises(latency.CannotRun, match="the compiler has not ended within 1 s: it was killed"):
        children.finished(words, "the compiler", 1.0)
    assert len(Path(words[-1]).read_text().split()) == 2
    assert time.monotonic() - begun < 10.0


def test_a_compiler_that_does_not_work_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: "/bin/false")
    with pytest.raises(latency.CannotRun, match=r"/bin/false _timerloop\.c: "):
        latency.compiled(tmp_path)


def test_the_loop_in_c_has_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "timerloop"
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(latency, "LATE_S", 0.3)
    with pytest.raises(latency.CannotRun, match=r"the loop in C has not ended within 0\.4 s"):
        latency.bare(program, False, 0.1)
