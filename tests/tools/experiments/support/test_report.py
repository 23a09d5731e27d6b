from __future__ import annotations

import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tools.ci.figures import bounded
from tools.experiments import __main__ as program
from tools.experiments.paper_figures import table1
from tools.experiments.support.report import Picture, Report, Skipped, Table, Work, draw, save


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
    shown = capsys.readouterr().err
    assert f"{'#' * 10}{'.' * 20} 1/3 squares" in shown
    assert f"{'#' * 30} 3/3 squares" in shown


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
        modules[name] = ModuleType(name, "What it is about.")
        modules[name].run = run  # type: ignore[attr-defined]  # a module is made up
    monkeypatch.setattr(program, "EXPERIMENTS", dict.fromkeys(runs, "Fig. 9"))
    monkeypatch.setattr(program, "MODULES", {name: f"tools.experiments.{name}" for name in runs})
    imported = program.importlib.import_module

    def known(path: str, package: str | None = None) -> ModuleType:
        """Anything else is imported: where no test before has drawn, drawing imports parts of its own."""
        return modules.get(path.rpartition(".")[2]) or imported(path, package)

    monkeypatch.setattr(program.importlib, "import_module", known)


def test_program_runs_skips_and_reports(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def skips(quick: bool, work: Work) -> Report:
        raise Skipped("no data")

    def breaks(quick: bool, work: Work) -> Report:
        raise ZeroDivisionError("oops")

    pretend(monkeypatch, good=lambda quick, work: a_report(), skips=skips, breaks=breaks)
    assert program.main(["--out", str(tmp_path), "--quick", "--only", "good", "--only", "skips"]) == 0
    out = capsys.readouterr().out
    assert "skipped: no data" in out
    assert "with care" in out
    data = json.loads((tmp_path / "good.json").read_text())
    assert data["command"] == "python -m tools.experiments --only good --quick"
    assert data["quick"] is True
    assert math.isfinite(data["seconds"])
    assert program.main(["--out", str(tmp_path)]) == 1
    assert "breaks could not run: ZeroDivisionError('oops')" in capsys.readouterr().out


def test_a_run_goes_on_where_it_was_interrupted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ran: list[str] = []

    def good(quick: bool, work: Work) -> Report:
        ran.append("good")
        return a_report()

    def interrupted(quick: bool, work: Work) -> Report:
        ran.append("later")
        if len(ran) == 2:
            raise KeyboardInterrupt
        return a_report()

    pretend(monkeypatch, good=good, later=interrupted)
    words = ["--out", str(tmp_path)]
    with pytest.raises(KeyboardInterrupt):
        program.main(words)
    assert program.main(words) == 0
    assert ran == ["good", "later", "later"]
    assert program.main([*words, "--only", "good", "--again"]) == 0
    assert program.main([*words, "--only", "good", "--trials", "3"]) == 0
    monkeypatch.setattr(program, "code", lambda *sources: "other code")
    assert program.main([*words, "--only", "good"]) == 0
    assert ran[3:] == ["good"] * 3


def test_a_quick_part_does_not_replace_a_whole_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pretend(monkeypatch, good=lambda quick, work: a_report())
    words = ["--out", str(tmp_path)]
    assert program.main([*words, "--quick"]) == 0
    assert program.main(words) == 0
    with pytest.raises(SystemExit):
        program.main([*words, "--quick"])
    assert "holds whole runs of good" in capsys.readouterr().err
    assert json.loads((tmp_path / "good.json").read_text())["quick"] is False
    assert program.parse([]).out == program.RESULTS
    assert program.parse(["--quick"]).out == program.QUICK


def test_the_pages_say_what_there_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pretend(monkeypatch, good=lambda quick, work: a_report(), none=lambda quick, work: Report())
    assert program.main(["--out", str(tmp_path), "--jobs", "1"]) == 0
    index = (tmp_path / "README.md").read_text()
    assert "| [good](good.md) | Fig. 9 | What it is about. | 1 of 1 |" in index
    assert "| [none](none.md) | Fig. 9 | What it is about. | - |" in index
    page = (tmp_path / "good.md").read_text()
    for part in ("--only good`", "seeds 1, 2", "(line.png)", "## by links", "| three | 1.235 |", "| all | - |",
                 "| error | 2.5 | cm | <= 5 | ok |", "with care"):  # fmt: skip
        assert part in page, part


@pytest.mark.parametrize("words", [["--only", "nothing"], ["--jobs", "0"], ["sounds"]])
def test_wrong_words_end_the_program(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        program.main(words)
    assert caught.value.code == 2
    assert words[-1] in capsys.readouterr().err


def test_every_experiment_is_offered() -> None:
    """A module of the folder that can be run as one is in the list, and what is in the list is there."""
    folder = Path(program.__file__).parent
    found = {path for path in folder.rglob("*.py") if "def run(quick: bool, work: Work)" in path.read_text()}
    offered = {folder.parents[1] / (program.MODULES[name].replace(".", "/") + ".py") for name in program.EXPERIMENTS}
    assert found == offered


def test_the_conditions_of_the_paper_are_those_of_the_room() -> None:
    report = table1.run(True, Work())
    assert report.figures[0].ok, report.tables[0].text()


def test_results_that_are_stored_are_not_made_again(tmp_path: Path) -> None:
    made: list[tuple[int, str]] = []
    items = [(1, "a b"), (2, "c")]
    for wanted in (items[:1], items):
        assert Work().map(lambda item: made.append(item) or item[0], wanted, keep=tmp_path) == [k for k, _ in wanted]
    assert made == items
