"""The rows of belief: all are there, and the smallest of each sort runs on what tests can make by themselves."""

from pathlib import Path

import numpy as np
import pytest

from tests.daemon.replay.room import carmen, drive
from tools.experiments import __main__ as program
from tools.experiments.belief import belief, constants, logs, walls
from tools.experiments.belief.spoil import KINDS, spoil
from tools.experiments.support.report import Report, Skipped, Work


def test_every_row_is_registered_and_names_its_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named = ["clean", "perturbed", "spoiled", "wheels", "mount", "lies", "solutions", "reference", "speed"]
    assert list(belief.ROWS) == named
    assert {"belief", "constants"} <= set(program.EXPERIMENTS) & set(program.MODULES)
    assert program.parse(["--only", "belief", "--rows", "clean,lies"]).out == program.ROWS
    monkeypatch.delenv(logs.VARIABLE, raising=False)
    with pytest.raises(Skipped, match="row clean is left out"):
        belief.run(False, Work(rows=("clean",)))
    with pytest.raises(Skipped, match="no row of mine"):
        belief.run(False, Work(rows=("of mine",)))


@pytest.mark.jit
def test_rows_run_on_a_drive_of_the_simulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    carmen(tmp_path / "room.clf", drive(160))
    monkeypatch.setenv(logs.VARIABLE, str(tmp_path))
    monkeypatch.setattr(logs, "LOGS", {"room": logs.Log("room.clf", logs.SICK)})
    monkeypatch.setattr("tools.experiments.belief.real_rows.BASES", ("room",))
    monkeypatch.setattr("tools.experiments.belief.replays.kept", lambda: tmp_path / "kept")
    found = belief.run(False, Work(trials=1, rows=("clean", "perturbed", "wheels")))
    values = {figure.name: figure.value for figure in found.figures}
    assert values["clean drives with wheels: guesses after 5 s"] == 0
    assert 0.0 < values["spread of the end pose, worst log, other lidars"] < 0.1
    assert all("--rows" in figure.command for figure in found.figures)
    wheels = {row[0]: row for row in next(table for table in found.tables if "Wheels" in table.title).rows}
    assert wheels["slipped 3 m"][1] == 1
    assert len(list((tmp_path / "kept").iterdir())) == 1 + 1 + 5


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_spoils_what_it_says_and_leaves_a_log(tmp_path: Path, kind: str) -> None:
    carmen(tmp_path / "room.clf", drive(160))
    whole, spoiled = logs.read(tmp_path / "room.clf"), spoil(logs.read(tmp_path / "room.clf"), "room", kind, 1)
    again = logs.read(spoiled.write(tmp_path / "again.clf"))
    assert np.allclose(again.ranges, spoiled.ranges, atol=1e-3)
    same = len(whole.stamps) == len(again.stamps) and all(
        np.array_equal(getattr(whole, name), getattr(again, name)) for name in ("stamps", "ranges", "laser", "robot")
    )
    assert not same


def test_two_walls_of_a_bent_map_are_found() -> None:
    s = np.linspace(0.0, 4.0, 120)
    turned = np.deg2rad(95.0)
    walls_of = np.concatenate([np.column_stack([s, 0 * s]), np.outer(0.8 * s, (np.cos(turned), np.sin(turned))) - 0.3])
    assert walls.between(walls_of) == pytest.approx(95.0, abs=0.1)


def test_constants_are_counted_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "a.py").write_text(
        'A, B_M = 1, 0.5\n"""Both, m."""\nNAMES = ("a",)\nclass MyErrors:\n    """Of it.\n\n    Attributes:\n'
        '        slip: m per metre.\n    """\n    slip: float = 0.1\n'
    )
    found = [row[:3] for row in constants.constants("part", tmp_path)]
    assert found == [("A", "1", "Both, m."), ("B_M", "0.5", "Both, m."), ("MyErrors.slip", "0.1", "m per metre.")]
    report = constants.run(True, Work())
    assert isinstance(report, Report)
    assert report.figures[0].value > 100
