"""The experiment that locates lamps by a drive runs, finds every lamp, and reaches its number."""

from __future__ import annotations

import numpy as np
import pytest

from tools.experiments import survey
from tools.experiments.support.report import Work


@pytest.mark.slow
def test_quick() -> None:
    report = survey.run(True, Work())
    assert report.figures[0].name.startswith("lamps located, height given")
    assert report.figures[0].value < 0.08
    assert len(report.tables[0].rows) == 2


@pytest.mark.slow
def test_sixteen_lamps_from_one_drive() -> None:
    table = survey.trial((7, survey.HEIGHT_M, 1))  # a seed nothing was tried with
    assert len(table) == 16
    assert np.median(survey.distance(table)) < 0.05
