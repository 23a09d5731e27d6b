"""Curves and areas against their definitions; a few matches judged end to end."""

from __future__ import annotations

import numpy as np
import pytest

from tools.bench.support.scenes import office
from tools.experiments import beamquality as bq
from tools.experiments.support.report import Work


def test_the_area_is_that_under_the_curve() -> None:
    rng = np.random.default_rng(0)
    true, false = rng.normal(1.0, 1.0, 300), rng.normal(0.0, 1.0, 200)
    x, y = bq.roc(true, false)
    assert np.all(np.diff(x) >= 0.0)
    assert np.all(np.diff(y) >= 0.0)
    assert x[-1] == y[-1] == 1.0
    assert bq.area(true, false) == pytest.approx(float(np.trapezoid(y, x)), abs=0.01)
    assert bq.area(np.zeros(3), np.zeros(3)) == 0.5
    assert bq.area(np.ones(3), np.zeros(3)) == 1.0


def test_true_matches_score_higher() -> None:
    said = bq.scores(office(), 0.05, 12)
    assert set(said) == {"beam model", "share that fits", "evidence not against"}
    for true, false in said.values():
        assert len(true) > 5
        assert len(false) > 1
        assert np.median(true) > np.median(false)


@pytest.mark.slow
def test_quick() -> None:
    report = bq.run(True, Work())
    assert len(report.tables[0].rows) == 9
    assert report.figures[1].value > 0.0
