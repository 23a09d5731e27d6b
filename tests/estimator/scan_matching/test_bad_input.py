"""Bad input to the matcher and to the whole step: a reason, never an exception, never a confident wrong pose."""

import numpy as np
import pytest

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.result import MatchResult
from estimator.scan_matching.scan_matcher import MatchSettings, Prior, match
from tests.estimator.world import map_of, moved, prior_at, scan_in, view_of
from tools.bench.support.scenes import Scene, bearings, office, paper_room

OUTSIDE = 16.27
"""Squared Mahalanobis distance, three degrees of freedom, 99.9 %."""


def off(result: MatchResult, truth: Array) -> Array:
    """Error in the axes that the match says it knows."""
    e = result.T_odom_base - truth
    e[2] = se2.wrap(e[2])
    return np.asarray(e * result.known_axes)


def lies(result: MatchResult, truths: list[Array]) -> bool:
    """Whether a result is off by more than 5 cm, and beyond its own ellipse, from every place that looks the same."""
    errors = [off(result, truth) for truth in truths]
    far = [np.hypot(e[0], e[1]) > 0.05 and float(e @ result.information @ e) > OUTSIDE for e in errors]
    return result.ok and all(far)


def alike(scene_name: str, T: Array) -> list[Array]:
    """Places that no lidar can tell from ``T``: the paper's room is the same after a quarter of a turn."""
    quarters = range(4) if scene_name == "room" else range(1)
    return [se2.compose(np.array((0.0, 0.0, 0.5 * np.pi * q)), T) for q in quarters]


SCENES: dict[str, Scene] = {"room": paper_room(), "office": office(), "other office": office(5)}


@pytest.mark.jit
@pytest.mark.parametrize("beams", [181, 1081])
@pytest.mark.parametrize("name", SCENES)
def test_a_guess_three_metres_off_is_no_confident_wrong_pose(name: str, beams: int) -> None:
    """Whatever the prediction says of itself, sure or vague: the place is found, or the match says that it is not."""
    scene, rng = SCENES[name], np.random.default_rng(17)
    bearing = bearings(beams, 180.0 if beams < 200 else 270.0)
    refused, wrong = 0, []
    for k in range(60):
        T = scene.place(rng)
        local = map_of([(T, scan_in(scene, T, bearing, rng))])
        T_new = se2.compose(T, np.array((0.05, 0.02, 0.03)))
        view = view_of(scan_in(scene, T_new, bearing, rng))
        guess = moved(T_new, rng, 3.0, rng.uniform(0.0, np.pi))
        for sd_m, sd_rad in ((0.05, 0.03), (0.5, 0.3), (3.0, 1.0)):
            result = match(view, local, prior_at(guess, sd_m, sd_rad), 50, MatchSettings())
            refused += not result.ok
            if not result.ok:
                np.testing.assert_array_equal(result.T_odom_base, guess)
                np.testing.assert_array_equal(result.known_axes, 0.0)
            elif lies(result, alike(name, T_new)):
                wrong.append((k, sd_m, off(result, T_new), result.inliers / result.queries))
    assert wrong == []
    assert refused > 60


@pytest.mark.jit
@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.5 * np.pi), (0.0, 0.0, np.pi), (0.6, -0.4, 0.3)])
def test_a_wrong_mount_moves_nothing_by_itself(mount: tuple[float, float, float]) -> None:
    """The same lidar with another mount in map and scan: that is a rigid shift, found as one or refused."""
    scene, rng, bearing = paper_room(), np.random.default_rng(5), bearings(361, 270.0)
    for _ in range(20):
        T = scene.place(rng)
        local = map_of([(T, scan_in(scene, T, bearing, rng))])
        scan = scan_in(scene, T, bearing, rng)
        wrong = view_of(
            type(scan)(*(getattr(scan, name) if name != "T_base_lidar" else np.array(mount) for name in scan.__slots__))
        )
        result = match(wrong, local, Prior(T, np.diag((400.0, 400.0, 1600.0))), 50, MatchSettings())
        shifted = se2.compose(T, se2.inverse(np.array(mount)))
        assert not lies(result, alike("room", shifted))
