"""Golden trajectories: their contents, the report of a difference, references of other machines."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.replay.results import Trajectory
from estimator.result import Loop
from tests.logs import bless, golden, made
from tests.logs.__main__ import main
from tests.logs.catalog import origin
from tests.logs.entries import ENTRIES, Entry


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)
def test_a_golden_file_says_what_it_is(entry: Entry) -> None:
    for name in (entry.name, f"{entry.name}.live"):
        facts = golden.load(name).facts
        assert facts["log"] == origin(entry)
        assert len(facts["reason"]) > 10
        assert (golden.FOLDER / f"{name}.txt").stat().st_size < 20_000


def test_recordings_of_the_simulator_are_small_and_real_ones_are_not_committed() -> None:
    kept = {path.name for path in made.FOLDER.iterdir()}
    assert kept == {f"{name}.tar.xz" for name in made.MADE}
    assert all(made.packed(name).stat().st_size < 300_000 for name in made.MADE)
    assert all(entry.sha256 for entry in ENTRIES if entry.source)


def test_what_a_person_is_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LUMILOOP_DATA", raising=False)
    assert main(["room", "exp1"]) == 1, "it was asked for"
    told = capsys.readouterr().out
    assert "room   same" in told
    assert "exp1   not replayed: LUMILOOP_DATA" in told
    assert "1 of 2 logs not replayed (exp1): LUMILOOP_DATA does not name" in told
    with pytest.raises(SystemExit):
        main(["nowhere"])
    blessed, live = golden.load("room"), golden.load("room.live")
    for where, off_m in ((golden.environment(), 1e-5), ("another processor", 1.1e-3)):  # wherever this runs
        facts = {**blessed.facts, "environment": where}
        moved = replace(blessed, facts=facts, poses=blessed.poses + np.array((off_m, 0.0, 0.0)))
        read = {"room": moved, "room.live": live}
        monkeypatch.setattr(golden, "load", lambda name, folder=None, read=read: read[name])
        assert main(["room"]) == 1
        told = capsys.readouterr().out
        assert "MOVED" in told
        assert f"first at stamp {blessed.stamps[0]:.6f} by {off_m:.6f} m" in told
        read.update({"room": blessed, "room.live": replace(moved, stamps=live.stamps, poses=live.poses + off_m)})
        assert main(["room"]) == 1
        assert "; live, " in (told := capsys.readouterr().out)
        assert f"first at stamp {live.stamps[0]:.6f}" in told.partition("; live, ")[2]
    near = replace(moved, poses=blessed.poses + np.array((0.9e-3, 0.0, 0.0)))
    read.update({"room": near, "room.live": live})
    assert main(["room"]) == 0
    assert "another processor, or other versions: 0.0009" in capsys.readouterr().out


def test_another_machine_keeps_a_reference_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(golden, "HERE", tmp_path / "out" / "golden")
    committed = golden.FOLDER / "room.txt"
    before = committed.read_bytes()
    monkeypatch.setattr(golden, "environment", lambda: "this machine")
    assert main(["room"]) == 0
    assert "to 1 mm only; bless --here keeps a reference" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["bless", "--here", "room"])
    assert bless.main() == 0
    assert "room: new" in capsys.readouterr().out
    assert committed.read_bytes() == before
    assert main(["room"]) == 0
    assert "by this machine's own reference, same machine: 0.00000" in capsys.readouterr().out
    own = tmp_path / "out" / "golden" / "room.txt"
    text = own.read_text()
    own.write_text(text.replace("# digest: ", "# digest: 0"))
    assert main(["room"]) == 1, "a micrometre between two kept poses"
    assert "poses between those that are kept differ" in capsys.readouterr().out
    monkeypatch.setattr(golden, "environment", lambda: "a third machine")
    assert main(["room"]) == 0
    assert "to 1 mm only" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["bless", "--here", "--reason", "a machine needs no reason", "room"])
    with pytest.raises(SystemExit):
        bless.main()
    assert "--here" in capsys.readouterr().err


def test_a_change_of_two_micrometres_is_seen(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(golden, "FOLDER", tmp_path)
    poses = np.random.default_rng(1).normal(size=(25, 3))
    trajectory = Trajectory(np.arange(25.0), poses)
    golden.save("x", trajectory, 10, golden.facts_of(trajectory, [], "a log", "a test"))
    blessed = golden.load("x")
    assert golden.largest_difference(blessed, trajectory, 10) <= golden.TIGHT_M
    assert golden.largest_difference(blessed, trajectory, 10, motion=True) <= 4 * golden.TIGHT_M
    turned = poses @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + (3.0, -5.0, np.pi / 2)
    elsewhere = Trajectory(np.arange(25.0), turned)
    assert golden.largest_difference(blessed, elsewhere, 10, motion=True) < 1e-5  # the same drive in another frame
    assert golden.largest_difference(blessed, elsewhere, 10) > 1.0
    moved = poses.copy()
    moved[20, 0] += 2e-6
    assert golden.largest_difference(blessed, Trajectory(np.arange(25.0), moved), 10) > golden.TIGHT_M
    between = poses.copy()
    between[13, 1] += 2e-6  # not among the kept poses: the digest tells
    assert golden.judged(blessed, trajectory, [], 10).same
    assert not golden.judged(blessed, Trajectory(np.arange(25.0), between), [], 10).same
    assert not golden.judged(blessed, trajectory, [Loop(1, 9, 2, 0.01)], 10).same, "another loop"
    away = golden.judged(blessed, Trajectory(np.arange(25.0), moved), [], 10)
    assert not away.same
    assert "same machine: moved by up to 0.000002 m, first at stamp 20.000000 by 0.000002 m" in away.said
    assert "10.000000 was the last as blessed" in away.said
    monkeypatch.setattr(golden, "environment", lambda: "another processor")
    assert golden.judged(blessed, Trajectory(np.arange(25.0), between), [], 10).same
    near, far = (poses + np.array((0.0, off, 0.0)) for off in (0.9e-3, 1.1e-3))
    assert golden.judged(blessed, Trajectory(np.arange(25.0), near), [], 10).same
    assert not golden.judged(blessed, Trajectory(np.arange(25.0), far), [], 10).same
    assert not golden.judged(blessed, trajectory, [Loop(1, 9, 2, 0.01)], 10).same
    assert golden.largest_difference(blessed, Trajectory(np.arange(24.0), poses[:24]), 10) == float("inf")
