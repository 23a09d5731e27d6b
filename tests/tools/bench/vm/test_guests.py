"""Scenarios of the virtual bench shared out between computers: what fails, what is left out, and what is told of it."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from tools.bench.report.plots import Plot
from tools.bench.report.result import Figure, Seen
from tools.bench.vm import bench, common, guests, places
from tools.bench.vm.booted import Booted
from tools.bench.vm.guests import Guest, Turns, run_all, tried
from tools.bench.vm.image import Image


class Lived:
    """A bench whose daemon has these lives, one after the other; the last one stays."""

    def __init__(self, *lives: tuple[int, int], life: tuple[int, int] = (0, 0)) -> None:
        self.left, self.life = list(lives), life

    def lives(self) -> tuple[int, int]:
        return self.left.pop(0) if len(self.left) > 1 else self.left[0]

    def log(self, lines: int) -> str:
        return "its log"


def like(function: Callable[[bench.Bench], str], daemon: common.Daemon = "same") -> common.Scenario:
    """A scenario outside the list."""
    common.AFTER[function] = daemon
    return function


@pytest.fixture(autouse=True)
def _only_the_lists_own_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "AFTER", dict(common.AFTER))
    monkeypatch.setattr(guests, "AFTER", common.AFTER)
    monkeypatch.setattr(guests, "ALONE", set())


def passes(bench: bench.Bench) -> str:
    """It passes."""
    return "seen"


def needs_more(bench: bench.Bench) -> str:
    """It needs what has not been seen."""
    raise KeyError("drive")


def test_a_scenario_that_builds_on_one_that_failed_fails_itself() -> None:
    result = tried(like(needs_more), Lived((0, 0)))  # type: ignore[arg-type]  # all that is looked at
    assert not result.passed
    assert result.said == "what it builds on has not been seen: KeyError('drive')"


def falls_short(bench: bench.Bench) -> str:
    """It is not what it should be."""
    raise common.Unmet("12 mm", Seen("150 poses", (Figure("apart", 12.0, "mm"),), (Plot("apart", "m", "mm", ()),)))


def test_what_falls_short_is_reported_with_its_figures_and_plots() -> None:
    result = tried(like(falls_short), Lived((0, 0)))  # type: ignore[arg-type]  # all that is looked at
    assert not result.passed
    assert result.said == "12 mm"
    assert ([str(one) for one in result.figures], [one.title for one in result.plots]) == (["apart: 12 mm"], ["apart"])


@pytest.mark.parametrize(
    ("daemon", "before", "after", "as_wanted"),
    [
        ("same", (7, 0), (7, 0), True),
        ("same", (7, 0), (8, 1), False),
        ("same", (7, 0), (7, 1), False),
        ("same", (7, 0), (0, 0), False),
        ("same", (0, 0), (0, 0), True),
        ("anew", (0, 0), (7, 0), True),
        ("anew", (7, 0), (7, 0), True),
        ("anew", (0, 0), (8, 1), False),
        ("anew", (0, 0), (0, 0), False),
        ("restarted", (7, 0), (8, 1), True),
        ("restarted", (7, 0), (7, 0), False),
        ("restarted", (7, 0), (9, 2), False),
        ("gone", (7, 0), (0, 0), True),
        ("gone", (7, 0), (7, 0), False),
    ],
)
def test_a_daemon_that_dies_unnoticed_fails_the_scenario(
    daemon: common.Daemon, before: tuple[int, int], after: tuple[int, int], as_wanted: bool
) -> None:
    lived = Lived(after, life=before)
    result = tried(like(passes, daemon), lived)  # type: ignore[arg-type]  # all that is looked at
    assert result.passed is as_wanted
    assert as_wanted or result.said.startswith("the daemon has died unnoticed: process ")
    assert lived.life == after


class Playing:
    """What a guest runs in, without a guest."""

    def __init__(self, broken_off: threading.Event) -> None:
        self.broken_off = broken_off
        self.machine = self
        self.life = (0, 0)
        self.worked, self.slower = 0.0, 1.0

    def __enter__(self) -> Playing:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def lives(self) -> tuple[int, int]:
        return self.life

    def worked_s(self) -> float:
        self.worked += 1.5
        return self.worked

    def run(self, *words: str, seconds: float) -> str:
        return "the journal"


def dies(bench: bench.Bench) -> str:
    """QEMU ends in the middle of it."""
    raise places.CannotBench("QEMU has ended with -9")


def is_left(bench: bench.Bench) -> str:
    """Somebody presses Ctrl-C in the middle of it."""
    os.kill(os.getpid(), 2)
    bench.machine.broken_off.wait(20.0)
    raise places.BrokenOff


def errs(bench: bench.Bench) -> str:
    """There is a mistake in it."""
    raise AttributeError("spelt wrongly")


def kept(folder: Path) -> Booted:
    return Booted(Image(folder), folder)


def played_by_two(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    *shares: list[common.Scenario],
    say: Callable[[str], None] = lambda text: None,
) -> tuple[bool, list[list[str]], str]:
    monkeypatch.setattr(guests, "bench", lambda booted, folder, broken_off, nice: Playing(broken_off))
    both = [Guest(k + 1, share) for k, share in enumerate(shares)]
    (tmp_path / "work").mkdir()
    whole = run_all(both, kept(tmp_path), tmp_path / "work", tmp_path, say)
    said = " ".join(one.skipped or one.said for guest in both for one in guest.results)
    return whole, [[one.outcome for one in guest.results] for guest in both], said


def test_a_computer_that_dies_leaves_a_report_of_what_was_and_what_was_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares = [like(passes), like(dies), passes, passes], [like(errs), passes]
    whole, outcomes, said = played_by_two(monkeypatch, tmp_path, *shares)
    assert whole
    assert outcomes == [["passed", "FAILED", "skipped", "skipped"], ["FAILED", "passed"]]
    assert "QEMU has ended with -9" in said
    assert "not run: the emulated computer had ended" in said
    assert "spelt wrongly" in said
    assert (tmp_path / "journal-2.log").read_text() == "the journal"


@pytest.mark.parametrize(("slower", "at_once"), [(1.0, 3), (3.5, 2)])
def test_a_slow_emulation_runs_two_computers_at_a_time(
    slower: float, at_once: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, most, lock = 0, 0, threading.Lock()
    met = threading.Barrier(at_once)

    def meets(bench: bench.Bench) -> str:
        """It is there when the others are; the last of three alone is not waited for."""
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        with contextlib.suppress(threading.BrokenBarrierError):
            met.wait(1.0)
        bench.machine.broken_off.wait(0.2)
        with lock:
            running -= 1
        return "seen"

    def made(booted: Booted, folder: Path, broken_off: threading.Event, nice: int) -> Playing:
        playing = Playing(broken_off)
        playing.slower = slower
        return playing

    monkeypatch.setattr(guests, "bench", made)
    monkeypatch.setattr(guests, "LOOK_S", 0.01)
    (tmp_path / "work").mkdir()
    said: list[str] = []
    three = [Guest(k, [like(passes), like(meets)]) for k in (1, 2, 3)]
    assert run_all(three, kept(tmp_path), tmp_path / "work", tmp_path, said.append)
    assert all(one.passed for guest in three for one in guest.results)
    assert most == at_once
    told = [line for line in said if "times slower" in line]
    assert told == (
        ["the emulation is 3.5 times slower than usual: 2 computers at a time"] if slower > guests.SLOW else []
    )


@pytest.mark.parametrize(("slower", "beside"), [(1.0, True), (3.5, False)])
def test_a_drive_that_is_compared_has_a_slow_machine_to_itself(
    slower: float, beside: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second computer has one scenario after the other; none of them in the first one's drive, where it is slow."""
    running: set[str] = set()
    seen: list[set[str]] = []
    lock, known = threading.Lock(), threading.Barrier(2)

    def comes_up(bench: bench.Bench) -> str:
        """Both know how fast they are before either goes on."""
        known.wait(20.0)
        return "up"

    def goes(name: str, seconds: float) -> common.Scenario:
        def scenario(bench: bench.Bench) -> str:
            """It takes a while."""
            with lock:
                running.add(name)
                seen.append(set(running))
            bench.machine.broken_off.wait(seconds)
            with lock:
                seen.append(set(running))
                running.discard(name)
            return "seen"

        return like(scenario)

    def made(booted: Booted, folder: Path, broken_off: threading.Event, nice: int) -> Playing:
        playing = Playing(broken_off)
        playing.slower = slower
        return playing

    drives, others = goes("drives", 0.3), [goes(f"other {k}", 0.05) for k in range(20)]
    monkeypatch.setattr(guests, "bench", made)
    monkeypatch.setattr(guests, "ALONE", {drives})
    monkeypatch.setattr(guests, "LOOK_S", 0.01)
    (tmp_path / "work").mkdir()
    both = [Guest(1, [like(comes_up), drives]), Guest(2, [comes_up, *others])]
    assert run_all(both, kept(tmp_path), tmp_path / "work", tmp_path, lambda text: None)
    assert all(one.passed for guest in both for one in guest.results)
    assert any(len(names) == 2 for names in seen if "drives" in names) is beside
    begun = next(k for k, names in enumerate(seen) if "drives" in names)
    before = {name for names in seen[:begun] for name in names}
    assert len(before) <= 3, "the others wait with their next ones once it wants to drive"


def test_who_wants_to_be_alone_does_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guests, "PATIENCE_S", 0.05)
    monkeypatch.setattr(guests, "LOOK_S", 0.01)
    turns, nobody, broken_off = Turns(), threading.Event(), threading.Event()
    broken_off.set()
    with turns.taken(False, nobody), turns.taken(True, nobody):
        third = turns.taken(False, broken_off)
        with pytest.raises(places.BrokenOff):  # who comes then waits all the same
            third.__enter__()
    with turns.taken(False, nobody):
        pass


def test_the_computer_with_most_to_do_is_the_first_and_who_stands_back_goes_by_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[tuple[str, int]] = []

    def made(booted: Booted, folder: Path, broken_off: threading.Event, nice: int) -> Playing:
        begun.append((folder.name, nice))
        return Playing(broken_off)

    monkeypatch.setattr(guests, "bench", made)
    monkeypatch.setattr(guests, "SIDE_BY_SIDE", 1)
    monkeypatch.setattr(guests, "SLOW", 0.0)  # one after the other
    monkeypatch.setattr(guests, "LOOK_S", 0.01)
    (tmp_path / "work").mkdir()
    three = [Guest(k, [like(passes)]) for k in (1, 2, 3)]
    assert run_all(three, kept(tmp_path), tmp_path / "work", tmp_path, lambda text: None)
    assert begun == [("3", 2), ("1", 0), ("2", 5)]


def test_who_waits_for_a_turn_can_be_broken_off_and_holds_up_nobody_then() -> None:
    turns, broken_off = Turns(), threading.Event()
    broken_off.set()
    with turns.taken(False, threading.Event()):
        with pytest.raises(places.BrokenOff), turns.taken(True, broken_off):
            pass
        with turns.taken(False, threading.Event()):  # nobody wants to be alone any more
            pass
    with turns.taken(True, broken_off), pytest.raises(places.BrokenOff), turns.taken(False, broken_off):
        pass


def test_what_the_emulation_has_worked_is_told_with_each_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guests, "bench", lambda booted, folder, broken_off, nice: Playing(broken_off))
    (tmp_path / "work").mkdir()
    guest = Guest(1, [like(passes), passes])
    run_all([guest], kept(tmp_path), tmp_path / "work", tmp_path, lambda text: None)
    assert [str(figure) for one in guest.results for figure in one.figures] == 2 * ["work of the emulation: 1.5 CPU s"]


def test_a_computer_that_has_ended_leaves_what_was_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends at the end of a scenario: what that has shown stays, and the next one says why it cannot be."""
    monkeypatch.setattr(Playing, "worked_s", lambda playing: None)
    _, outcomes, said = played_by_two(monkeypatch, tmp_path, [like(passes), like(dies), passes])
    assert outcomes == [["passed", "FAILED", "skipped"]]
    assert "seen QEMU has ended with -9" in said


def test_a_computer_without_a_folder_to_work_in_says_what_was_not_run(tmp_path: Path) -> None:
    """A share that is not in the results would be taken for one that has passed."""
    told: list[str] = []
    guest = Guest(1, [like(passes), passes])
    with pytest.raises(FileNotFoundError):
        guest.run(kept(tmp_path), tmp_path / "gone" / "1", tmp_path, told.append, Turns())
    assert [one.outcome for one in guest.results] == ["skipped", "skipped"]
    assert all("the bench has met an error of its own" in text for text in told)
    assert len(told) == 2


def test_what_takes_time_to_ask_for_is_asked_for_where_it_is_told() -> None:
    asked: list[int] = []
    common.need(True, lambda: f"{asked.append(1)}")
    assert asked == []
    with pytest.raises(bench.Order, match="the log"):
        common.need(False, lambda: "the log")


def test_a_run_that_is_broken_off_says_what_was_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, outcomes, said = played_by_two(monkeypatch, tmp_path, [like(passes), like(is_left), passes])
    assert not whole
    assert outcomes == [["passed", "skipped", "skipped"]]
    assert said.count("not run: the run was broken off") == 2


def test_a_run_that_is_broken_off_twice_is_so_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """timeout(1) sends its signal to a program and to the group that it is in."""
    heard: list[str] = []

    def say(text: str) -> None:
        if text.startswith("broken off"):
            heard.append(text)
            if len(heard) == 1:
                os.kill(os.getpid(), 15)  # the first one is still being seen to

    whole, outcomes, _ = played_by_two(monkeypatch, tmp_path, [like(is_left), passes], say=say)
    assert not whole
    assert outcomes == [["skipped", "skipped"]]
    assert len(heard) == 1
