"""The program of the experiments, and the numbers that pages quote of their results."""

import json
import math
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tools.ci.figures import bounded
from tools.experiments import __main__ as program
from tools.experiments.support.report import Picture, Report, Skipped, Table, Work

DOCS = Path(__file__).parents[3] / "docs"
PAGES = "\n".join(
    page.read_text()
    for page in sorted(DOCS.rglob("*.md"))
    if page.parent.name != "results" or page.name.startswith("measured-")
)


def tables(name: str) -> dict[str, Any]:
    """Rows of a result's tables by title and first cell."""
    found = json.loads((DOCS / "results" / f"{name}.json").read_text())
    return {table["title"]: {row[0]: row[1:] for row in table["rows"]} for table in found["tables"]}


def quoted(first: str) -> list[str]:
    """Cells of the row of the pages that begins so, without marks."""
    (row,) = re.findall(rf"^\| {re.escape(first)} \|(.*)\|$", PAGES, re.MULTILINE)
    return [cell.strip().replace("**", "") for cell in row.split("|")]


@pytest.mark.parametrize("campaign", ["RSS", "RSS_0923"])
@pytest.mark.parametrize("solver", ["ls", "lin", "ml"])
def test_recorded_strengths(campaign: str, solver: str) -> None:
    rows = tables("fig4")[f"recorded, {campaign}: position error, cm, split half"]
    pairs = zip(rows[f"{solver}, median"], rows[f"{solver}, 90th percentile"], strict=True)
    assert quoted(f"{campaign}: `{solver}`") == [f"{median:.1f} ({most:.1f})" for median, most in pairs]
    if solver == "ls":
        assert rows["ls, median"][0] == min(rows["ls, median"]), "the page says that three links are best"


def test_recorded_walks() -> None:
    ((_, walks),) = tables("walks").items()
    mean, most = walks["circle_inclined10"][2], walks["square_blocked"][4]
    bare, level = walks["circle_inclined10, lean not used"][2], walks["circle_level, two-fold"][2]
    assert quoted("receiver inclined by 10 deg, mean")[0] == f"{mean:.1f} cm ({bare:.1f} cm without the lean)"
    assert quoted("LEDs covered now and then, 90th percentile")[0] == f"{most:.1f} cm"
    assert quoted("level, each half by the other, mean")[0] == f"{level:.1f} cm"


def test_light_as_driven_does_not_raise_recall() -> None:
    driven = tables("fig6")["As driven"]
    lit, laser = driven["laser and lights"][6], driven["laser alone"][6]
    assert lit < laser
    for words in ("Light as driven does not raise recall**: {} with lights, {} by the laser alone",):
        assert words.format(f"{lit:.1f} %", f"{laser:.1f} %") in PAGES


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
