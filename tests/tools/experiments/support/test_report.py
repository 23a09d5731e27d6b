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
from tools.experiments.support.report import Picture, Report, Skipped, Table, Work


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
