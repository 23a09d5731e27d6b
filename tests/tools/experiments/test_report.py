from __future__ import annotations

import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tools.experiments import __main__ as program
from tools.experiments.report import Picture, Report, Skipped, Table, Work, draw, save
from tools.figures import bounded


def square(x: int) -> int:
    return x * x


def fail(x: int) -> int:
    raise ValueError(f"trial {x}")


def a_report() -> Report:
    def line(canvas: Any) -> None:
        canvas.subplots().plot([0, 1], [0, 1])

    return Report(
        figures=(bounded("error", np.float64(2.5), "cm", "<= 5", "again"),),
        tables=(
            Table("by links", ("links", "median"), (("three", 1.23456), ("all", float("nan")), ("k", np.int64(7)))),
        ),
        pictures=(Picture("line", line),),
        seeds=(1, 2),
        notes=("with care",),
    )


@pytest.mark.parametrize("jobs", [1, 2])
def test_map_keeps_the_order(jobs: int) -> None:
    assert Work(jobs).map(square, range(5)) == [0, 1, 4, 9, 16]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failing_trial_is_not_swallowed(jobs: int) -> None:
    with pytest.raises(ValueError, match="trial 0"):
        Work(jobs).map(fail, range(3))


def test_no_processes_is_an_error() -> None:
    with pytest.raises(ValueError, match="jobs = 0"):
        Work(0)


def test_progress(capsys: pytest.CaptureFixture[str]) -> None:
    Work(1, progress=True).map(square, range(3), "squares")
    assert "squares 3/3" in capsys.readouterr().err


def test_saved_data_is_complete_json(tmp_path: Path) -> None:
    paths = save("demo", a_report(), {"seconds": 1.5}, tmp_path)
    assert [path.name for path in paths] == ["demo.json", "line.png"]
    data = json.loads(paths[0].read_text())
    assert data["seeds"] == [1, 2]
    assert data["seconds"] == 1.5
    assert data["figures"][0]["value"] == 2.5
    assert data["figures"][0]["ok"] is True
    assert data["tables"][0]["rows"] == [["three", 1.23456], ["all", None], ["k", 7]]
    assert paths[1].read_bytes()[:4] == b"\x89PNG"


def test_without_matplotlib_there_are_no_pictures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    assert draw(a_report(), tmp_path) == []


def test_table_text_is_aligned() -> None:
    text = Table("t", ("links", "cm"), (("three", 1.23456), ("4", 10.0))).text()
    assert text.splitlines() == ["t", "links     cm", "three  1.235", "4         10"]


def pretend(monkeypatch: pytest.MonkeyPatch, **runs: Any) -> None:
    """Experiments with the given ``run``; the program finds just these."""
    modules = {}
    for name, run in runs.items():
        modules[name] = ModuleType(name)
        modules[name].run = run  # type: ignore[attr-defined]  # a module is made up
    monkeypatch.setattr(program, "available", lambda group: list(runs))
    monkeypatch.setattr(program.importlib, "import_module", lambda path: modules[path.rsplit(".", 1)[1]])


def test_program_runs_skips_and_reports(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def skips(quick: bool, work: Work) -> Report:
        raise Skipped("no data")

    def breaks(quick: bool, work: Work) -> Report:
        raise ZeroDivisionError("oops")

    pretend(monkeypatch, good=lambda quick, work: a_report(), skips=skips, breaks=breaks)
    assert program.main(["lights", "--out", str(tmp_path), "--quick", "--only", "good", "--only", "skips"]) == 0
    out = capsys.readouterr().out
    assert "skipped: no data" in out
    assert "with care" in out
    data = json.loads((tmp_path / "good.json").read_text())
    assert data["command"] == "python -m tools.experiments lights --only good --quick"
    assert data["quick"] is True
    assert math.isfinite(data["seconds"])
    assert program.main(["lights", "--out", str(tmp_path)]) == 1
    assert "breaks could not run: ZeroDivisionError('oops')" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["lights", "--only", "nothing"], ["lights", "--jobs", "0"], ["sounds"]])
def test_wrong_words_end_the_program(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        program.main(words)
    assert caught.value.code == 2
    assert words[-1] in capsys.readouterr().err


def test_only_what_exists_is_offered() -> None:
    for name in program.available("lights"):
        assert (Path(program.__file__).parent / f"{name}.py").is_file()
