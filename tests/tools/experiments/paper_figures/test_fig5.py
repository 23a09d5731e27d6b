"""Fig. 5: errors are what they say, the second pass goes on from the first, lamps age as told."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tools.experiments.paper_figures import fig5
from tools.experiments.support import outings
from tools.experiments.support.report import Work, save
from tools.experiments.support.trajectory import Track, errors, fitted, moved, started
from tools.sim.ceiling.ceiling import paper_ceiling


def circle(n: int = 100) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * np.pi, n)
    return np.column_stack((2.0 * np.cos(turn), 2.0 * np.sin(turn), turn))


def test_errors_of_a_known_offset() -> None:
    truth = circle()
    found = errors(Track(np.arange(100.0), truth + np.array((0.3, 0.4, math.radians(2.0))), truth))
    assert (found.rmse, found.largest, found.end) == pytest.approx((0.5, 0.5, 0.5))
    assert found.heading == pytest.approx(2.0)


def test_a_rigid_motion_is_fitted_away_and_a_wrong_start_is_put_right() -> None:
    truth = circle()
    far = moved(truth, np.zeros(3), np.array((3.0, -1.0, 2.5)))
    track = Track(np.arange(100.0), far, truth)
    assert errors(track).rmse > 1.0
    for mended in (fitted(track), started(track)):
        assert errors(mended).rmse == pytest.approx(0.0, abs=1e-9)
        assert errors(mended).heading == pytest.approx(0.0, abs=1e-9)


def test_a_fit_is_the_best_there_is() -> None:
    rng, truth = np.random.default_rng(2), circle()
    best = fitted(Track(np.arange(100.0), truth + 0.1 * rng.standard_normal(truth.shape), truth))
    least = errors(best).rmse
    for _ in range(50):
        step = rng.normal(0.0, 0.01, 3)
        other = Track(best.t, moved(best.pose, np.zeros(3), step), truth)
        assert errors(other).rmse >= least


def test_lamps_age_by_half_to_all_of_the_share_either_way() -> None:
    new = paper_ceiling(seed=4)
    old = outings.aged_by(new, 0.3)
    change = old.powers(np.array([400.0]))[0] / new.powers(np.array([400.0]))[0] - 1.0
    assert np.abs(change).min() > 0.14
    assert np.abs(change).max() < 0.31
    assert change.min() < 0.0 < change.max()
    assert outings.aged_by(new, 0.0) is new


def test_the_second_pass_goes_on_where_the_first_ends() -> None:
    out = outings.outing("room", 1, 2.0)
    first, second = out.odometry(0), out.odometry(1)
    assert (first[0].t_begin, first[-1].t_end, second[0].t_begin) == pytest.approx((0.0, 2.0, 2.0))
    assert out.light(1)[0].t_begin == 2.0
    assert out.scans(1)[0].t_begin >= 2.0


def test_laser_alone_follows_the_first_metres_and_one_seed_gives_one_result() -> None:
    out = outings.outing("tour", 2, 6.0)
    seen, wheels = out.scans(0), out.odometry(0)
    ends = []
    for _ in range(2):
        robot = outings.fresh(out.run, False)
        tracks = outings.play(robot, (wheels, seen)).tracks(robot.state, out.run.truth)
        found = errors(started(tracks["live"]))
        assert found.rmse < 0.02
        assert np.hypot(*np.ptp(tracks["live"].pose[:, :2], axis=0)) > 1.0
        np.testing.assert_allclose(tracks["kept"].pose, tracks["live"].pose, atol=1e-9)  # nothing has corrected the map
        ends.append(tracks["live"].pose[-1])
    np.testing.assert_array_equal(*ends)
    reckoned = outings.reckoned(wheels, tracks["live"].t, out.run.truth)
    assert errors(reckoned).rmse < 0.1


@pytest.mark.slow
def test_a_small_part_of_all_of_it(tmp_path: Path) -> None:
    report = fig5.run(True, Work())
    values = {figure.name: figure.value for figure in report.figures}
    assert values["room, ours, laser alone: trajectory RMSE, worst"] < 5.0
    assert values["room, ours, laser and lights: trajectory RMSE, worst"] < 60.0  # of its first seconds
    paths = save("fig5", report, {}, tmp_path)
    assert [path.name for path in paths] == ["fig5.json", "fig5-room.png"]
