"""The autosaver of a recording's folder: what it takes away where states cannot be had, and which dumps it keeps."""

import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from daemon.recording import retention
from daemon.recording.retention import ASKED, ASKED_DUMPS, DUMP, DUMPS, RING, Begun, Flight
from hal.replay.recording import segment_name

SEGMENT = 1000


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ring of five segments on a disk with room."""
    monkeypatch.setattr(retention, "LEAST_BYTES", 5 * SEGMENT)
    monkeypatch.setattr(retention, "MB_A_MINUTE", 0)
    monkeypatch.setattr(retention, "RESERVE_BYTES", 0)


def ring(folder: Path) -> Flight:
    folder.mkdir(parents=True)
    return Flight(folder, 60.0)


def grow(autosaver: Flight, folder: Path, segments: int) -> None:
    """Segments that are complete, each followed by one for which no state could be taken."""
    for number in range(segments):
        path = folder / segment_name(number)
        path.write_bytes(bytes(SEGMENT))
        autosaver.closed(number, path)
        autosaver.begun(Begun(number + 1, 10.0 * number, None, b"", {}))


def ended(folder: Path) -> bool:
    """Whether the next start may take a ring away."""
    return (folder / RING).read_bytes() != b""


def test_a_ring_without_states_does_not_fill_the_disk(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    autosaver = ring(folder)
    grow(autosaver, folder, 50)
    autosaver.close(ended=True)
    left = sorted(folder.glob("*.lumirec"))
    assert len(left) == 10
    assert left[-1].name == segment_name(49)


def test_a_ring_without_states_keeps_its_beginning_as_long_as_there_is_room(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    autosaver = ring(folder)
    grow(autosaver, folder, 10)
    autosaver.close(ended=True)
    assert len(list(folder.glob("*.lumirec"))) == 10


def test_maps_that_were_switched_to_go_with_the_segments_that_took_them(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    autosaver = ring(folder)
    old, new = folder / "switch-0123456789abcdef.lumimap", folder / "switch-fedcba9876543210.lumimap"
    for path, age_s in ((old, 3600.0), (new, 0.0)):
        path.write_bytes(b"map")
        os.utime(path, (time.time() - age_s, time.time() - age_s))
    grow(autosaver, folder, 9)
    autosaver.close(ended=True)
    assert old.exists(), "nothing was taken away yet"
    autosaver = Flight(folder, 60.0)
    grow(autosaver, folder, 20)
    autosaver.close(ended=True)
    assert not old.exists()
    assert new.exists()


def test_the_dump_just_made_stays_whatever_the_clock_says(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for day in range(DUMPS):
        (tmp_path / f"{DUMP}2026-11-{day + 1:02d}T00-00-00Z-fault-101").mkdir()
    autosaver = ring(folder)
    grow(autosaver, folder, 1)
    told: list[str] = []
    autosaver.dump({"at": "1970-01-01T00-00-09Z", "reason": "fault-101", "why": "a test", "t_mono": 9.0}, told.append)
    autosaver.close(ended=True)
    assert told == [""]
    kept = sorted(path.name for path in tmp_path.glob(f"{DUMP}*"))
    assert len(kept) == DUMPS
    assert kept[0] == f"{DUMP}1970-01-01T00-00-09Z-fault-101"
    assert kept[1].startswith(f"{DUMP}2026-11-02")


def test_dumps_that_were_asked_for_do_not_push_out_those_of_faults(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for day in range(DUMPS + 3):
        (tmp_path / f"{DUMP}2026-10-{day + 1:02d}T00-00-00Z-fault-101").mkdir()
    autosaver = ring(folder)
    grow(autosaver, folder, 1)
    told: list[str] = []
    for _ in range(3 * ASKED_DUMPS):
        autosaver.dump({"at": "2026-11-09T00-00-09Z", "reason": ASKED, "why": "a test", "t_mono": 9.0}, told.append)
    autosaver.dump({"at": "2026-11-09T00-00-10Z", "reason": "fault-104", "why": "a test", "t_mono": 9.0}, told.append)
    autosaver.close(ended=True)
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

    monkeypatch.setattr(retention, "_linked", fails)
    autosaver = ring(tmp_path / "run")
    told: list[str] = []
    for _ in range(2):
        autosaver.dump({"at": "x", "reason": ASKED, "why": "a test", "t_mono": 9.0}, told.append)
    autosaver.close(ended=True)
    assert len(told) == 2
    assert all(told)
    assert autosaver.error
    assert not ended(tmp_path / "run"), "the ring is all there is of the dump, and the next start is to keep it"


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


ABOUT = {"at": "2026-11-09T00-00-10Z", "reason": "fault-104", "why": "a test", "t_mono": 9.0}


def test_a_ring_of_which_something_is_still_being_written_has_not_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a large state is, before the dump that waits for it; the next start keeps the ring."""
    monkeypatch.setattr(retention, "CLOSE_S", 0.05)
    folder, goes_on = tmp_path / "run", threading.Event()
    autosaver = ring(folder)
    autosaver.dump(ABOUT, lambda _: None if goes_on.wait(30.0) else pytest.fail("never"))
    autosaver.close(ended=True)
    assert not ended(folder)
    goes_on.set()
    autosaver._thread.join(30.0)
    autosaver.close(ended=True)
    assert ended(folder)


def test_a_dump_has_the_segment_that_is_being_written_though_there_is_no_state(tmp_path: Path) -> None:
    """At the start, before the estimator is loaded; whether the autosaver has heard of the segment yet or not."""
    folder = tmp_path / "run"
    autosaver = ring(folder)
    grow(autosaver, folder, 1)
    for number in (1, 2):
        (folder / segment_name(number)).write_bytes(b"as far as it is")
    (folder / ".000002.lumistate.part").touch()
    autosaver.dump(ABOUT, lambda _: None)
    autosaver.close(ended=True)
    (dump,) = tmp_path.glob(f"{DUMP}*")
    assert [path.name for path in sorted(dump.glob("*.lumirec"))] == list(map(segment_name, range(3)))
    assert (dump / segment_name(2)).samefile(folder / segment_name(2)), "it goes on growing"
    assert not list(dump.glob(".*"))


LARGE = 64 << 10


class Disk:
    """A small disk: what is on it counts once, however many links there are."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.bytes = folder, 1 << 30
        monkeypatch.setattr(retention.shutil, "disk_usage", lambda _: SimpleNamespace(free=self.bytes - self.used()))

    def used(self) -> int:
        files = (path.stat() for path in self.folder.rglob("*.lumirec"))
        return sum({one.st_ino: 512 * one.st_blocks for one in files}.values())

    def lacks(self, large: float) -> None:
        """So many large files too little."""
        self.bytes = self.used() + retention.RESERVE_BYTES - int(large * LARGE)


DAYS = {"01T00-00-00Z-asked": 1, "02T00-00-00Z-fault-101": 2, "03T00-00-00Z-died": 5, "04T00-00-00Z-fault-101": 4}
"""Dumps, by when they were made: the run that died had begun before."""


@pytest.fixture
def small_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    """With dumps that hold the room of one large file each, and of one that two of them hold."""
    monkeypatch.setattr(retention, "RESERVE_BYTES", 100 * LARGE)
    monkeypatch.setattr(retention, "LEAST_BYTES", 100 * LARGE)
    for name, made in DAYS.items():
        dump = tmp_path / f"{DUMP}2026-11-{name}"
        dump.mkdir()
        (dump / segment_name(0)).write_bytes(b"x" * LARGE)
        os.utime(dump, (1e9 + made, 1e9 + made))
    return Disk(tmp_path, monkeypatch)


def kept(folder: Path) -> list[str]:
    return sorted(path.name.removeprefix(f"{DUMP}2026-11-") for path in folder.glob(f"{DUMP}*"))


def turn(autosaver: Flight, folder: Path, number: int) -> None:
    """A segment is complete, and another one is begun, with a state."""
    path = folder / segment_name(number)
    path.write_bytes(b"x" * LARGE)
    autosaver.closed(number, path)
    autosaver._tasks.put(lambda: autosaver._segments.update({number + 1: retention._Segment(0, 10.0 * number, True)}))
    autosaver.begun(Begun(number + 1, 10.0 * number, None, b"", {}))


@pytest.mark.parametrize(
    ("large", "gone", "segments"),
    [
        (-1.0, [], 2),
        (0.5, ["02T00-00-00Z-fault-101"], 2),
        (1.5, ["02T00-00-00Z-fault-101", "04T00-00-00Z-fault-101"], 2),
        (2.5, ["01T00-00-00Z-asked", "02T00-00-00Z-fault-101", "04T00-00-00Z-fault-101"], 2),
        (3.5, ["01T00-00-00Z-asked", "02T00-00-00Z-fault-101", "04T00-00-00Z-fault-101"], 1),
        (50.0, ["01T00-00-00Z-asked", "02T00-00-00Z-fault-101", "04T00-00-00Z-fault-101"], 0),
    ],
)
def test_where_there_is_no_room_dumps_go_before_what_is_recorded(
    tmp_path: Path, small_disk: Disk, large: float, gone: list[str], segments: int
) -> None:
    """The oldest first, those that were asked for after the others, and the newest not at all."""
    folder = tmp_path / "run"
    autosaver = ring(folder)
    turn(autosaver, folder, 0)
    turn(autosaver, folder, 1)
    autosaver._tasks.put(lambda: small_disk.lacks(large))
    autosaver.begun(Begun(2, 20.0, None, b"", {}))
    autosaver.close(ended=True)
    assert kept(tmp_path) == sorted(DAYS.keys() - gone)
    assert len(list(folder.glob("*.lumirec"))) == segments


def test_room_that_two_dumps_hold_is_had_when_both_have_gone_and_the_one_just_made_stays(
    tmp_path: Path, small_disk: Disk
) -> None:
    folder = tmp_path / "run"
    autosaver = ring(folder)
    turn(autosaver, folder, 0)
    turn(autosaver, folder, 1)
    for second in (1, 2):
        autosaver.dump({**ABOUT, "at": f"1970-01-01T00-00-0{second}Z"}, lambda _: None)
    autosaver._tasks.put(lambda: [os.utime(dump, (1.0, 1.0)) for dump in tmp_path.glob(f"{DUMP}1970*")])
    autosaver._tasks.put(lambda: small_disk.lacks(0.5))
    autosaver.begun(Begun(2, 20.0, None, b"", {}))
    autosaver.close(ended=True)
    assert not (tmp_path / f"{DUMP}1970-01-01T00-00-01Z-fault-104").exists()
    assert (tmp_path / f"{DUMP}1970-01-01T00-00-02Z-fault-104").exists()
    assert len(list(folder.glob("*.lumirec"))) == 2


def test_where_a_dump_cannot_be_taken_away_what_is_recorded_is(
    tmp_path: Path, small_disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(retention.shutil, "rmtree", refused)
    folder = tmp_path / "run"
    autosaver = ring(folder)
    turn(autosaver, folder, 0)
    turn(autosaver, folder, 1)
    autosaver._tasks.put(lambda: small_disk.lacks(0.5))
    autosaver.begun(Begun(2, 20.0, None, b"", {}))
    autosaver.close(ended=True)
    assert kept(tmp_path) == sorted(DAYS)
    assert len(list(folder.glob("*.lumirec"))) == 1
    assert not autosaver.error
