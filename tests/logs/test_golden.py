"""Golden trajectories: what they are, what a person is told of them, how they are blessed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.replay.results import Trajectory
from estimator.result import Loop
from tests.logs import __main__ as command
from tests.logs import bless, golden, made
from tests.logs.__main__ import main
from tests.logs.catalog import origin
from tests.logs.entries import BY_NAME, ENTRIES, Entry


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


@pytest.mark.parametrize(
    ("spoil", "checked", "blessed"),
    [
        (lambda text: text.replace("# loops: ", "# loops: 9"), "loops", "moved by up to 0.00000"),
        (lambda text: text + "garbage\n", "room.txt: the number of columns changed", "what was there is damaged"),
        (lambda text: text.replace("# environment:", "#environment:"), "no line 'environment'", "damaged"),
        (lambda text: "", "room.txt: no such file; git checkout it", "room: new"),
    ],
)
def test_a_golden_file_that_somebody_has_edited_is_told_and_can_be_blessed(
    spoil: Callable[[str], str], checked: str, blessed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (golden.FOLDER / "room.txt").read_text()
    assert "# loops: " in text
    if spoilt := spoil(text):
        (tmp_path / "room.txt").write_text(spoilt)
    shutil.copy(golden.FOLDER / "room.live.txt", tmp_path)
    monkeypatch.setattr(golden, "FOLDER", tmp_path)
    entry = BY_NAME["room"]
    verdict = command.checked(entry, None)
    assert not verdict.same
    assert checked in verdict.said
    assert blessed in bless.bless(entry, None, "it had been edited")
    assert command.checked(entry, None).same
    assert bless.bless(entry, None, "it had been edited").splitlines() == ["room: unchanged", "room.live: unchanged"]


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


def test_real_logs_that_are_left_out_are_said_and_fail_where_all_are_demanded(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LUMILOOP_DATA", raising=False)
    monkeypatch.setattr(command, "checked", lambda entry, root: golden.Verdict(True, "as blessed"))
    real = [entry.name for entry in ENTRIES if entry.source]
    said = f"{len(real)} of {len(ENTRIES)} logs not replayed ({', '.join(real)}): LUMILOOP_DATA does not name"
    assert main([]) == 0
    assert f"{said} the folder of real logs; --all fails without them\n" in capsys.readouterr().out
    assert main(["--all"]) == 1
    assert capsys.readouterr().out.endswith(f"{said} the folder of real logs\n")
    monkeypatch.setenv("LUMILOOP_DATA", "/")
    assert main(["--all"]) == 0
    assert "not replayed" not in capsys.readouterr().out


def test_a_log_that_is_not_there_or_another_one_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LUMILOOP_DATA", str(tmp_path))
    monkeypatch.setattr("sys.argv", ["bless", "--reason", "only a trial of it", "scip"])
    before = (golden.FOLDER / "scip.txt").read_bytes()
    log = tmp_path / "scip" / "example_urg_04lx.logr"
    for said in ("No such file or directory; LUMILOOP_DATA names", "is another log than the one that was blessed"):
        assert main(["scip"]) == 1
        assert f"not replayed: {log}" in (told := capsys.readouterr().out)
        assert said in told
        assert bless.main() == 1
        assert f"scip: left as it is, {log}" in capsys.readouterr().out
        log.parent.mkdir(exist_ok=True)
        log.write_bytes(b"another log")
    assert (golden.FOLDER / "scip.txt").read_bytes() == before


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


def test_what_moved_says_where_that_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(golden, "FOLDER", tmp_path)
    stamps, poses = np.arange(100.0, 150.0), np.zeros((50, 3))
    trajectory = Trajectory(stamps, poses)
    golden.save("x", trajectory, 10, golden.facts_of(trajectory, [], "a log", "a test"))
    blessed = golden.load("x")

    def said(stamps: np.ndarray, poses: np.ndarray) -> str:
        return golden.judged(blessed, Trajectory(stamps, poses), [], 10).said

    moved = poses.copy()
    moved[20:] = (0.0, 0.0, -0.01)  # a turn alone moves the pose, too
    moved[40:] = (0.0, 0.5, 0.0)
    assert "moved by up to 0.500000 m, first at stamp 120.000000 by 0.010000 m" in said(stamps, moved)
    late = stamps + np.where(np.arange(50) < 30, 0.0, 0.1)
    assert "kept stamp 3 is the first that differs: 130.100000, 130.000000 when blessed" in said(late, poses)
    longer = np.arange(100.0, 161.0)
    assert "kept stamp 5 is the first that differs: 150.000000, 149.000000 when" in said(longer, np.zeros((61, 3)))
    assert "kept stamp 5 is the first that differs: no more, 149.000000 when" in said(stamps[:41], poses[:41])
    moved[30, 0] = np.nan
    assert "first at stamp 120.000000" in said(stamps, moved)


def test_what_cannot_be_done_is_said_before_anything_is_loaded() -> None:
    code = (
        "import sys\nfrom tests.logs.__main__ import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as end:\n    print(end.code, 'numba' in sys.modules)"
    )

    def said(*words: str, **names: str) -> tuple[str, str]:
        command = [sys.executable, "-c", code, *words]
        done = subprocess.run(command, env={**os.environ, **names}, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()[-1], done.stderr

    assert said("--help")[0] == "0 False"
    last, error = said("intel", LUMILOOP_DATA="/nowhere")
    assert last == "2 False"
    assert "LUMILOOP_DATA=/nowhere: no such folder" in error
