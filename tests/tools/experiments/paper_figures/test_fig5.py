"""Fig. 5: errors against a known offset; the laser alone over the first metres."""

import math

import numpy as np
import pytest

from tools.experiments.support import outings
from tools.experiments.support.trajectory import Track, errors, started


def circle(n: int = 100) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * np.pi, n)
    return np.column_stack((2.0 * np.cos(turn), 2.0 * np.sin(turn), turn))


def test_errors_of_a_known_offset() -> None:
    truth = circle()
    found = errors(Track(np.arange(100.0), truth + np.array((0.3, 0.4, math.radians(2.0))), truth))
    assert (found.rmse, found.largest, found.end) == pytest.approx((0.5, 0.5, 0.5))
    assert found.heading == pytest.approx(2.0)


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
