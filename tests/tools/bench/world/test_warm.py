"""A daemon of this computer that the world is played to finds its kernels compiled: who waits for its pose is told."""

from __future__ import annotations

import subprocess
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from daemon.runtime import warmup
from tools.bench.report.result import Result
from tools.bench.world import __main__ as world
from tools.bench.world import local
from tools.bench.world.stage import CannotPlay, Ends

ENDS = Ends("pty:x", ("127.0.0.1", 9), "", "")


def test_it_is_compiled_before_the_daemon_is_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing of it for a robot computer, which has kernels of its own."""
    order: list[str] = []

    @contextmanager
    def robot(scenario: object) -> Generator[Ends]:
        order.append("started")
        yield ENDS

    monkeypatch.setattr(world, "warm", lambda lamps, say: order.append(f"compiled, lamps {lamps}"))
    monkeypatch.setattr(world, "robot", robot)
    monkeypatch.setattr(world, "tried", lambda scenario, *_: [Result(scenario.names[0], "", True, 1.0, "")])
    assert world.main(["lap", "lamps", "--local", "--out", str(tmp_path)]) == 0
    assert order == ["compiled, lamps False", "started", "compiled, lamps True", "started"]
    assert world.main(["lap", "--modbus", "127.0.0.1:9", "--lidar", "pty:x", "--out", str(tmp_path)]) == 0
    assert len(order) == 4


def test_what_cannot_be_compiled_is_said_and_nothing_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def nowhere(lamps: bool, say: object) -> None:
        raise warmup.CannotLoad("kernels cannot be loaded: No space left on device")

    monkeypatch.setattr(world, "warm", nowhere)
    assert world.main(["lap", "--local", "--out", str(tmp_path)]) == 2
    assert "cannot be played: kernels cannot be loaded: No space" in capsys.readouterr().out


@pytest.mark.parametrize(("lamps", "mark"), [(False, "warm"), (True, "warm-lights")])
def test_it_is_said_once_and_not_where_an_earlier_start_has_done_it(
    lamps: bool, mark: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the command compiles it, with light where there are lamps."""
    kernels: set[Path] = set()
    ran: list[list[str]] = []

    def compiles(words: list[str], **how: object) -> SimpleNamespace:
        ran.append(words)
        kernels.add(tmp_path / "kernel")
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(warmup, "mark_of", lambda what: tmp_path / what)
    monkeypatch.setattr(warmup, "_compiled", lambda: set(kernels))
    monkeypatch.setattr(subprocess, "run", compiles)
    said: list[str] = []
    for _ in range(2):
        local.warm(lamps, said.append)
    assert (tmp_path / mark).exists()
    assert [("photodiode.bus=unix:/bus" in words) for words in ran] == [lamps]
    assert [line for line in said if line.startswith("1 kernels compiled in ")] == said[-1:]


def test_a_daemon_that_does_not_compile_them_is_told_by_its_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warmup, "mark_of", lambda what: tmp_path / what)
    monkeypatch.setattr(subprocess, "run", lambda words, **how: SimpleNamespace(returncode=1, stderr="no room\n"))
    with pytest.raises(CannotPlay, match="kernels are not compiled: no room"):
        local.warm(False, lambda text: None)
    assert not (tmp_path / "warm").exists()
