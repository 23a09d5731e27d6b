"""The room experiment scores what it says, and the walks are followed at all."""

import math

import numpy as np
import pytest

from tools.experiments import room
from tools.experiments.recorded import walks
from tools.experiments.support.report import Work


def test_scores_of_a_known_trace() -> None:
    t = np.arange(0.0, 100.0)
    rows = np.zeros((100, 10))
    rows[:, 0] = t
    rows[:, 1], rows[:, 2], rows[:, 3] = 0.03, 0.04, math.radians(2.0)
    rows[50:, 4] = 4.5  # within a metre of a wall
    rows[50:, 1:3] = 0.3, 0.4
    rows[5:, 6], rows[:, 7], rows[:, 8] = 1.0, 3.0, 1.0
    got = room.score(rows, 20.0)
    assert got.start_s == 5.0
    assert got.rmse == pytest.approx(5.0)
    assert got.p95 == pytest.approx(5.0)
    assert got.p95_all == pytest.approx(50.0)
    assert got.heading == pytest.approx(2.0)
    assert (got.nees, got.covered, got.good) == (3.0, 1.0, 1.0)


@pytest.mark.slow
def test_the_room_run_starts_and_stays_within_decimetres() -> None:
    report = room.run(True, Work())
    figures = {figure.name: figure.value for figure in report.figures}
    assert figures["room, gains 5 % off: RMSE, worst seed"] < 20.0  # of its first seconds
    assert figures["room, gains 5 % off: time to GOOD, worst seed"] < 6.0


def test_the_walks_are_followed(log_root: object) -> None:
    report = walks.run(True, Work())
    figures = {figure.name: figure.value for figure in report.figures}
    assert figures["walk inclined: mean error"] < 12.0
    assert figures["walk blocked: p90 error"] < 20.0
    rows = {str(row[0]): row for row in report.tables[0].rows}
    level, leaning = rows["circle_inclined10, lean not used"], rows["circle_inclined10"]
    assert float(leaning[3]) < float(level[3])  # the accelerometer helps
