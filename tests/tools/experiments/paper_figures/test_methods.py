"""The methods beside each other: which number stands for a row, and a small part of the whole."""

from pathlib import Path

import pytest

from estimator.paper import METHODS
from tools.experiments.paper_figures import methods
from tools.experiments.support.report import Work, save


def test_the_first_number_of_a_row_stands_for_it() -> None:
    figure = methods.figure_of("intel", ("pic", 1.5, 0.3, 20.0, 2.0, 99, 1.0))
    assert (figure.name, figure.value, figure.unit) == ("intel, pic: within 30 s", 1.5, "cm")
    assert methods.figure_of("exp1", ("paper", 40.0)).unit == "mm"
    assert set(methods.UNLIT) < set(METHODS)


@pytest.mark.slow
def test_a_small_part_of_all_of_it(tmp_path: Path) -> None:
    report = methods.run(True, Work())
    values = {figure.name: figure.value for figure in report.figures}
    assert set(values) == {f"simulated, {name}: rmse" for name in METHODS}
    assert all(0.0 < value < 60.0 for value in values.values()), "of the first seconds with lamps"
    assert [len(row) for row in report.tables[0].rows] == [len(report.tables[0].head)] * len(METHODS)
    assert [path.name for path in save("methods", report, {}, tmp_path)] == ["methods.json"]
