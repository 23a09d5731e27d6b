"""Fig. 6: what is right is told by the simulator, conditions and thresholds do what they say, a short drive runs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimator.mapping.keyframe import keep
from estimator.measurements import Beam, Scan
from estimator.numerics import se2
from tools.experiments import islands
from tools.experiments.paper_figures import fig6
from tools.experiments.paper_figures.fig6_curves import Point, accepted, best, counted, point, right, rule
from tools.experiments.paper_figures.fig6_trial import LASER, LIT, Detection, Drive, Way, trial
from tools.experiments.paper_figures.fig6_truth import Truth
from tools.experiments.support.loop_drives import HOME, room_drive, room_route
from tools.experiments.support.report import Work, save
from tools.experiments.support.trajectory import Errors
from tools.sim.robot.drive import smooth

GOOD = Detection(1, 1, False, 0.9, 0.0, 0.007, True, 1.0, 1.0, 0.01, 0.001, True, (0.0, 0.0, 0.0))
MIRROR = replace(GOOD, off_m=8.5, off_rad=math.pi, positive=False, light=9000.0, place=(8.0, 0.0, 3.0))


def drive(*found: Detection) -> Drive:
    way = Way([GOOD], {1: True, 2: True, 3: False}, Errors(0.02, 0.05, 0.01, 0.1))
    return Drive(1, {LIT: way, LASER: way}, list(found), {1: True, 2: True, 3: False})


@pytest.mark.parametrize("seed", range(20))
def test_a_way_stays_clear_of_walls_and_columns_and_comes_home(seed: int) -> None:
    points = smooth(room_route(seed, 80.0))
    np.testing.assert_allclose(points[0], points[-1])
    assert np.hypot(*(points[0] - HOME)) < 0.6  # corners are rounded, the first one too
    assert np.abs(points).max() < 4.2
    for x in (-2.2, 2.2):
        for y in (-2.2, 2.2):
            assert np.hypot(points[:, 0] - x, points[:, 1] - y).min() > 0.6
    assert 60.0 < np.hypot(*np.diff(points, axis=0).T).sum() < 100.0


def test_truth_is_the_simulators() -> None:
    """Keyframes laid at instants of a drive, told a wrong place: only where they truly were counts."""
    truth, bearing = Truth(room_drive(1, 40.0)), np.radians(np.linspace(-90.0, 90.0, 61))
    wrong = np.array((100.0, 0.0, 0.0))
    for key, t in ((1, 5.0), (2, 5.2), (3, 30.0)):
        scan = Scan(t, t, 0, np.zeros(3), bearing, np.full(61, 2.0), np.full(61, Beam.HIT, np.uint8), 0.01)
        frame = keep(key, wrong, wrong, scan, 0.0)
        frame.submap.key = 1 if key < 3 else 2
        truth.laid(frame, t)
    assert not truth.near(2, 1)  # the same place, but only just now
    truth.way[3] += 20.0
    truth.pose[3] = se2.compose(truth.pose[1], np.array((0.3, 0.0, 0.2)))
    assert truth.near(3, 1)
    assert truth.has_positive(3)
    assert truth.positive(3, 1)
    truth.pose[3] = se2.compose(truth.pose[1], np.array((0.3, 0.0, math.radians(31.0))))
    assert not truth.near(3, 1)
    true = se2.between(truth.pose[1], truth.pose[3])
    assert truth.off(3, 1, se2.compose(true, np.array((0.3, 0.4, 0.0)))) == pytest.approx((0.5, 0.0), abs=1e-9)
    assert truth.overlap(3, [3]) == 1.0
    truth.seen[3] = {(1000, 1000)}
    assert truth.overlap(3, [1, 2]) == 0.0


def test_right_is_the_same_place_and_the_right_pose() -> None:
    assert right(GOOD)
    assert not right(replace(GOOD, positive=False))
    assert not right(replace(GOOD, off_m=0.21))
    assert not right(replace(GOOD, off_rad=math.radians(1.1)))


def test_the_mirror_image_is_told_by_light_only() -> None:
    both = drive(GOOD, MIRROR, replace(MIRROR, submap=2))
    assert point([both], rule(5, True)) == Point(1, 1, 2, 1)
    alone = accepted(both, rule(4, False))
    assert [one.submap for one in alone] == [2]  # two places fit in the first submap: none is taken
    assert point([both], rule(4, False)).precision == 0.0
    assert not accepted(drive(replace(GOOD, light=math.nan)), rule(5, True))  # paused
    assert not accepted(drive(replace(GOOD, by_light=True)), rule(4, False))
    assert not accepted(drive(GOOD), rule(5, True, sse_m=0.005))
    assert not accepted(drive(GOOD), rule(5, True, share=0.95))
    assert not accepted(drive(replace(GOOD, shared=0.9)), rule(6, True))


def test_precision_and_recall() -> None:
    assert counted([GOOD, replace(GOOD, submap=2), MIRROR], {1: True, 2: True, 3: False}) == (3, 2, 2, 1)
    p = Point(3, 2, 2, 1)
    assert (p.precision, p.recall, p.f1) == pytest.approx((2 / 3, 0.5, 4 / 7))
    assert best([p, Point(1, 1, 4, 1)], 0.99) == 0.25
    assert math.isnan(best([p], 0.99))
    assert Point(0, 0, 2, 0).precision == 1.0


def test_the_report_has_its_tables_and_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fig6, "trial", lambda task: drive(GOOD, MIRROR))
    report = fig6.run(True, Work())
    save("fig6", report, {}, tmp_path)
    assert (tmp_path / "fig6.json").exists()
    assert {figure.name: figure.value for figure in report.figures}[
        "loops as driven, with lights: recall"
    ] == pytest.approx(50.0)
    assert len(report.tables[1].rows) == 6


def test_lamps_of_a_case_are_as_the_case_says() -> None:
    whole = islands.ceiling_for(islands.CASES[1], 1)
    few = islands.ceiling_for(next(case for case in islands.CASES if case.islands), 1)
    assert 6 <= len(few.fixtures) < 0.4 * len(whole.fixtures)
    reused = islands.ceiling_for(next(case for case in islands.CASES if case.reused), 1)
    assert len({lamp.code for lamp in reused.fixtures}) == islands.CODES
    moved = islands.drive_of(next(case for case in islands.CASES if case.moved), 1)
    told = np.array([(lamp.x, lamp.y) for lamp in moved.survey.lamps])
    assert (np.hypot(*(moved.ceiling.placed[:, :2] - told).T) > 0.5).sum() == 2
    dead = islands.drive_of(next(case for case in islands.CASES if case.dead and not case.islands), 1)
    dark = (dead.ceiling.powers(np.array([1.0]))[0] == 0.0).sum()
    assert dark == round(islands.DEAD * len(whole.fixtures))
    assert len(dead.survey.lamps) == len(whole.fixtures)


@pytest.mark.slow
def test_a_short_drive_closes_right_loops_only() -> None:
    short = trial((1, 40.0))
    for way in short.ways.values():
        assert way.loops
        assert all(right(one) or one.off_m < 0.05 for one in way.loops)
    assert short.queries
    assert islands.trial((islands.CASES[0], 1, 30.0)).live.rmse < 0.2
