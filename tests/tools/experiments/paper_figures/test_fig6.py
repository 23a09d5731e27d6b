"""Fig. 6: truth comes from the simulator; precision and recall; a short drive closes right loops only."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.mapping.keyframe import keep
from estimator.measurements import Beam, Scan
from estimator.numerics import se2
from tools.experiments import islands
from tools.experiments.paper_figures.fig6_curves import Point, best, counted, right
from tools.experiments.paper_figures.fig6_trial import Detection, trial
from tools.experiments.paper_figures.fig6_truth import Truth
from tools.experiments.support.loop_drives import room_drive

GOOD = Detection(1, 1, False, 0.9, 0.0, 0.007, True, 1.0, 1.0, 0.01, 0.001, True, (0.0, 0.0, 0.0))
MIRROR = replace(GOOD, off_m=8.5, off_rad=math.pi, positive=False, light=9000.0, place=(8.0, 0.0, 3.0))


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


def test_precision_and_recall() -> None:
    assert counted([GOOD, replace(GOOD, submap=2), MIRROR], {1: True, 2: True, 3: False}) == (3, 2, 2, 1)
    p = Point(3, 2, 2, 1)
    assert (p.precision, p.recall, p.f1) == pytest.approx((2 / 3, 0.5, 4 / 7))
    assert best([p, Point(1, 1, 4, 1)], 0.99) == 0.25
    assert math.isnan(best([p], 0.99))
    assert Point(0, 0, 2, 0).precision == 1.0


@pytest.mark.slow
def test_a_short_drive_closes_right_loops_only() -> None:
    short = trial((1, 40.0))
    for way in short.ways.values():
        assert way.loops
        assert all(right(one) or one.off_m < 0.05 for one in way.loops)
    assert short.queries
    assert islands.trial((islands.CASES[0], 1, 30.0)).live.rmse < 0.2
