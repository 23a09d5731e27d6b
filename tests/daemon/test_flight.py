"""The keeper of a recording's folder: what it takes away where states cannot be had, and which dumps it keeps."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from daemon import flight
from daemon.flight import ASKED, ASKED_DUMPS, DUMP, DUMPS, RING, Begun, Flight
from hal.replay.recording import segment_name

SEGMENT = 1000


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ring of five segments on a disk with room."""
    monkeypatch.setattr(flight, "LEAST_BYTES", 5 * SEGMENT)
    monkeypatch.setattr(flight, "MB_A_MINUTE", 0)
    monkeypatch.setattr(flight, "RESERVE_BYTES", 0)


def ring(folder: Path) -> Flight:
    folder.mkdir(parents=True)
    return Flight(folder, 60.0)


def grow(keeper: Flight, folder: Path, segments: int) -> None:
    """Segments that are complete, each followed by one for which no state could be taken."""
    for number in range(segments):
        path = folder / segment_name(number)
        path.write_bytes(bytes(SEGMENT))
        keeper.closed(number, path)
        keeper.begun(Begun(number + 1, 10.0 * number, None, b"", {}))


def test_a_ring_without_states_does_not_fill_the_disk(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    keeper = ring(folder)
    grow(keeper, folder, 50)
    keeper.close(ended=True)
    left = sorted(folder.glob("*.lumirec"))
    assert len(left) == 10
    assert left[-1].name == segment_name(49)


def test_a_ring_without_states_keeps_its_beginning_as_long_as_there_is_room(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    keeper = ring(folder)
    grow(keeper, folder, 10)
    keeper.close(ended=True)
    assert len(list(folder.glob("*.lumirec"))) == 10


def test_maps_that_were_switched_to_go_with_the_segments_that_took_them(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    keeper = ring(folder)
    old, new = folder / "switch-0123456789abcdef.lumimap", folder / "switch-fedcba9876543210.lumimap"
    for path, age_s in ((old, 3600.0), (new, 0.0)):
        path.write_bytes(b"map")
        os.utime(path, (time.time() - age_s, time.time() - age_s))
    grow(keeper, folder, 9)
    keeper.close(ended=True)
    assert old.exists(), "nothing was taken away yet"
    keeper = Flight(folder, 60.0)
    grow(keeper, folder, 20)
    keeper.close(ended=True)
    assert not old.exists()
    assert new.exists()


def test_the_dump_just_made_stays_whatever_the_clock_says(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for day in range(DUMPS):
        (tmp_path / f"{DUMP}2026-11-{day + 1:02d}T00-00-00Z-fault-101").mkdir()
    keeper = ring(folder)
    grow(keeper, folder, 1)
    told: list[str] = []
    keeper.dump({"at": "1970-01-01T00-00-09Z", "reason": "fault-101", "why": "a test", "t_mono": 9.0}, told.append)
    keeper.close(ended=True)
    assert told == [""]
    kept = sorted(path.name for path in tmp_path.glob(f"{DUMP}*"))
    assert len(kept) == DUMPS
    assert kept[0] == f"{DUMP}1970-01-01T00-00-09Z-fault-101"
    assert kept[1].startswith(f"{DUMP}2026-11-02")


def test_dumps_that_were_asked_for_do_not_push_out_those_of_faults(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for day in range(DUMPS + 3):
        (tmp_path / f"{DUMP}2026-10-{day + 1:02d}T00-00-00Z-fault-101").mkdir()
    keeper = ring(folder)
    grow(keeper, folder, 1)
    told: list[str] = []
    for _ in range(3 * ASKED_DUMPS):
        keeper.dump({"at": "2026-11-09T00-00-09Z", "reason": ASKED, "why": "a test", "t_mono": 9.0}, told.append)
    keeper.dump({"at": "2026-11-09T00-00-10Z", "reason": "fault-104", "why": "a test", "t_mono": 9.0}, told.append)
    keeper.close(ended=True)
    assert told == [""] * (3 * ASKED_DUMPS + 1)
    kept = [path.name for path in tmp_path.glob(f"{DUMP}*")]
    assert sum(f"-{ASKED}" in name for name in kept) == ASKED_DUMPS
    assert sum("-fault-101" in name for name in kept) == DUMPS - 1
    assert f"{DUMP}2026-11-09T00-00-10Z-fault-104" in kept


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ZeroDivisionError("a defect")])
def test_whoever_asks_for_a_dump_is_told_whatever_happens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(flight, "_linked", fails)
    keeper = ring(tmp_path / "run")
    told: list[str] = []
    for _ in range(2):
        keeper.dump({"at": "x", "reason": ASKED, "why": "a test", "t_mono": 9.0}, told.append)
    keeper.close(ended=True)
    assert len(told) == 2
    assert all(told)
    assert keeper.error


@pytest.mark.parametrize("broken", ["rename", "unlink"])
def test_a_power_cut_while_a_dead_ring_is_made_a_dump_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    """Either the next start makes it one, or it is one already and its mark goes."""

    class PowerCut(BaseException):
        pass

    def cut(*_: object, **__: object) -> None:
        raise PowerCut

    dead = tmp_path / "run"
    ring(dead).close(ended=False)
    (dead / segment_name(0)).write_bytes(b"what was recorded last")
    with monkeypatch.context() as patch:
        patch.setattr(Path, broken, cut)
        with pytest.raises(PowerCut):
            ring(tmp_path / "second")
    last = ring(tmp_path / "third")
    last.close(ended=True)
    (kept,) = tmp_path.glob(f"{DUMP}*/{segment_name(0)}")
    assert kept.parent.name == f"{DUMP}run-died"
    assert not (kept.parent / RING).exists()
    assert not dead.exists()
