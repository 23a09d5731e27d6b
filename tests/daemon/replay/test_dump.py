"""Dumps of the flight recorder, replayed: they begin in the middle of a run and give the same poses to the last bit."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from daemon import blackbox, cli, disk
from daemon.flight import DUMP
from tests.daemon.replay.test_recorded_run import Bench, record


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk's thread lives in real time, the daemon in virtual time: both are to get somewhere."""
    monkeypatch.setattr(disk, "WRITE_S", 0.002)
    monkeypatch.setattr(blackbox, "EVERY_S", 2.0)
    monkeypatch.setattr(blackbox, "LEAST_S", 2.0)


def let_write(seconds: float) -> None:
    """Virtual time stands still for the writing threads."""
    time.sleep(seconds)


def replayed(folder: Path, out: Path) -> dict[str, dict[str, object]]:
    assert cli.main(["replay", str(folder), "--out", str(out)]) == cli.OK
    summary: dict[str, dict[str, object]] = json.loads((out / "summary.json").read_text())
    return summary


def states(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.lumistate"))


async def long(bench: Bench) -> None:
    for _ in range(6):
        await bench.drive(2.0)
        let_write(0.05)


def test_every_state_is_a_beginning(tmp_path: Path) -> None:
    bench = record(tmp_path / "rec", long)
    assert not bench.recorder.failing
    (run,) = (tmp_path / "rec").iterdir()
    found = states(tmp_path / "rec")
    assert len(found) >= 3
    whole = replayed(run, tmp_path / "whole")["recorded_run"]
    assert whole["differ"] == 0
    for number, state in enumerate(found):
        for old in sorted(run.glob("*.lumirec")):
            if old.stem < state.stem:
                old.unlink()
                old.with_suffix(".lumistate").unlink(missing_ok=True)
        said = replayed(run, tmp_path / f"out{number}")
        assert said["recorded_run"]["differ"] == 0, said["recorded_run"]
        assert 0 < said["recorded_run"]["cycles"] < whole["cycles"]


async def asked(bench: Bench) -> None:
    """Command 7 in the middle of a drive."""
    await long(bench)
    said: list[str] = []
    bench.recorder.box.dump(said.append)
    for _ in range(100):
        await bench.drive(0.1)
        let_write(0.01)
        if said:
            break
    assert said == [""]
    await bench.drive(1.0)


def test_a_ring_holds_the_latest_and_a_dump_of_it_is_a_beginning(tmp_path: Path) -> None:
    bench = record(tmp_path / "rec", asked, keep_s=4.0)
    assert not bench.recorder.failing
    (ring,) = (path for path in (tmp_path / "rec").iterdir() if not path.name.startswith(DUMP))
    dumps = sorted((tmp_path / "rec").glob(f"{DUMP}*-asked"))
    assert len(dumps) == 1
    assert not (ring / "000000.lumirec").exists()
    for folder in (ring, *dumps):
        said = replayed(folder, tmp_path / f"out-{folder.name}")
        assert said["recorded_run"]["differ"] == 0, said["recorded_run"]
        assert 30 <= said["recorded_run"]["cycles"] < 100
