"""Studies of one figure each: a bound worked out by hand, and the numbers they reach on real logs or a drive."""

from pathlib import Path

import numpy as np
import pytest

from tools.experiments import corridor, survey
from tools.experiments.corridor_bound import Seen, Sizes, bound
from tools.experiments.recorded import tones, walks
from tools.experiments.support.report import Work

NOTHING = Sizes(0.0, 0.0, 0.0, 0.0, 0.0)


def epoch(along: float, slope: float = 0.7, variance: float = 1e-4, lamp: int = 1) -> Seen:
    return Seen(along, (lamp,), np.array([variance]), np.array([slope]), np.array([0.3]))


def test_one_link_of_a_lamp_that_is_known_to_the_last_is_one_measurement() -> None:
    (sigma,) = bound([epoch(0.0)], NOTHING, start_m=0.5)
    assert sigma**-2 == pytest.approx(0.5**-2 + 0.7**2 / 1e-4)


@pytest.mark.slow
@pytest.mark.jit
def test_a_short_drive_stays_within_5_cm_along_the_corridor() -> None:
    one = corridor.trial((corridor.CASES[1], 1, 25.0))
    assert corridor.rms(one.along) < 0.05
    assert corridor.rms(one.floor) < corridor.rms(one.along)


@pytest.mark.slow
def test_sixteen_lamps_from_one_drive() -> None:
    table = survey.trial((7, survey.HEIGHT_M, 1))  # a seed nothing was tried with
    assert len(table) == 16
    assert np.median(survey.distance(table)) < 0.05


def test_recorded_stream(log_root: Path) -> None:
    report = tones.run(True, Work())
    rows = {row[0]: np.array(row[1:], dtype=float) for row in report.tables[0].rows}
    joint = rows["200 ms, joint, folded waveforms"]
    assert joint.max() < 2.0
    assert np.all(joint < 1.5 * rows["200 ms, predicted by the solver"])
    third = {row[0]: row[1:] for row in report.tables[1].rows}["harmonic 3"]
    assert all(0.25 < float(share) < 0.36 for share in third)


def test_the_walks_are_followed(log_root: object) -> None:
    report = walks.run(True, Work())
    figures = {figure.name: figure.value for figure in report.figures}
    assert figures["walk inclined: mean error"] < 12.0
    assert figures["walk blocked: p90 error"] < 20.0
    rows = {str(row[0]): row for row in report.tables[0].rows}
    level, leaning = rows["circle_inclined10, lean not used"], rows["circle_inclined10"]
    assert float(leaning[3]) < float(level[3])  # the accelerometer helps
