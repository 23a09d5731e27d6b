"""A start that comes to nothing: the service manager is let wait, a stop ends that, and a terminal is told at once."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon import app
from daemon.app import Daemon, Environment
from daemon.cli import parser, run
from daemon.system import console
from hal.clock import LoopClock
from hal.fake.transport.memory_host import FakeOpener
from tests.daemon.scenarios.test_daemon import SETTINGS
from tests.daemon.support.whole_daemon import during

ROOT = Path(__file__).parents[3]


def refused(maps: Path) -> list[str]:
    """A run that needs a map, and there is none."""
    return ["run", "--set", "map.localise=true", "--set", f"map.folder={maps}", "--set", "modbus.port=0"]


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(30.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


def test_it_is_not_started_again_at_once(
    tmp_path: Path, manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "ANEW_S", 0.5)
    begun = time.monotonic()
    assert parser.main(refused(tmp_path / "maps")) == console.FAILED
    assert time.monotonic() - begun >= 0.5
    assert b"STATUS=cannot start" in manager.recv(1000)


def test_at_a_terminal_the_answer_comes_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    begun = time.monotonic()
    assert parser.main(refused(tmp_path / "maps")) == console.FAILED
    assert time.monotonic() - begun < run.ANEW_S / 2


@pytest.mark.system
def test_a_stop_ends_the_wait(tmp_path: Path, manager: socket.socket) -> None:
    command = [sys.executable, "-m", "daemon", *refused(tmp_path / "maps")]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, env=dict(os.environ))
    try:
        assert b"STATUS=cannot start" in manager.recv(1000)
        begun = time.monotonic()
        process.terminate()
        assert process.wait(run.ANEW_S) == -signal.SIGTERM
        assert time.monotonic() - begun < run.ANEW_S / 2
    finally:
        process.kill()
        process.wait()


@pytest.mark.virtual
async def test_a_start_that_hangs_is_not_excused_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """The service manager is asked for more time while the estimator is loaded; then it may begin anew."""
    asked: list[float] = []
    loop = asyncio.get_running_loop()
    clock = LoopClock(loop, utc_at_zero=1.7e9)

    def notified(*words: str) -> None:
        asked.extend(clock.now() for word in words if word.startswith("EXTEND_TIMEOUT_USEC="))

    monkeypatch.setattr(app, "notify", notified)
    world = Environment(clock, opener=FakeOpener(clock), warm_up=asyncio.Event().wait)
    await during(Daemon(SETTINGS, world), asyncio.sleep(app.STARTING_S + 60.0))
    assert len(asked) == pytest.approx(app.STARTING_S, abs=2)
    assert asked[-1] - asked[0] < app.STARTING_S
