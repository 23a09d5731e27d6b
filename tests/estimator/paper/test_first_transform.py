"""T1: the relative pose of the light solution applied to the reference keyframe, or the prediction."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.mapping.keyframe import Keyframe, keep
from estimator.measurements import Array
from estimator.numerics import se2
from estimator.paper.first_transform import LIKELY, from_light, predicted
from estimator.result import Virtual
from estimator.scan_matching.scan_matcher import Prior
from tests.estimator.world import scan_in
from tools.bench.support.scenes import bearings, paper_room


def frame_at(T_odom: Array) -> Keyframe:
    return keep(1, T_odom, T_odom, scan_in(paper_room(), np.zeros(3), bearings(19, 180.0), None), 0.0)


def seen_by_light(T: Array, sd: float) -> Virtual:
    return Virtual(T, np.diag((sd**2, sd**2, (0.2 * sd) ** 2)), frozenset({1, 2, 3, 4}))


def test_the_first_transform_is_the_relative_pose_of_light_on_the_keyframe() -> None:
    """T1 = X_ref^-1 X_new in the odom frame, wherever the odom frame lies in the map."""
    T_odom, made, X_ref = np.array((1.0, 2.0, 0.5)), np.array((0.2, 0.05, 0.1)), np.array((-3.0, 1.0, -2.0))
    frame = frame_at(T_odom)
    frame.virtual = seen_by_light(X_ref, 0.03)
    first = from_light(frame, seen_by_light(se2.compose(X_ref, made), 0.04), 2.5)
    np.testing.assert_allclose(first.T, se2.compose(T_odom, made), atol=1e-12)
    assert (first.misfit, first.links) == (2.5, 4)


def test_its_covariance_is_that_of_both_poses() -> None:
    """Against drawn errors of both poses: the difference of the two has the covariance that T1 claims."""
    rng, made, X_ref = np.random.default_rng(1), np.array((0.8, 0.3, 0.4)), np.array((-3.0, 1.0, -2.0))
    frame = frame_at(np.array((1.0, 2.0, 0.5)))
    frame.virtual, now = seen_by_light(X_ref, 0.03), seen_by_light(se2.compose(X_ref, made), 0.04)
    claimed = np.linalg.inv(from_light(frame, now, 0.0).L) - LIKELY
    drawn = []
    for _ in range(4000):
        e1, e2 = (rng.multivariate_normal(np.zeros(3), one.covariance) for one in (frame.virtual, now))
        relative = se2.between(X_ref + e1, now.T_map_base + e2)
        drawn.append(se2.compose(frame.T_odom_keyframe, relative) - se2.compose(frame.T_odom_keyframe, made))
    np.testing.assert_allclose(np.cov(np.array(drawn).T), claimed, atol=0.08 * float(claimed.max()))


def test_without_light_the_first_transform_is_the_prediction() -> None:
    prior = Prior(np.ones(3), np.eye(3))
    first = predicted(prior, frame_at(np.zeros(3)))
    assert first.T is prior.T
    assert first.L is prior.L
    assert (first.misfit, first.links) == (0.0, 0)


def test_light_at_the_keyframe_is_required() -> None:
    with pytest.raises(AssertionError):
        from_light(frame_at(np.zeros(3)), seen_by_light(np.zeros(3), 0.1), 0.0)
