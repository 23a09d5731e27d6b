"""Eq. 13-15 on the group of rigid motions: combination, weights, what T1 is, and that nothing is counted twice."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.fusion import map_odom_filter
from estimator.fusion.map_pose import SurveyAlignment
from estimator.measurements import Array
from estimator.numerics import se2
from estimator.paper import point_to_point_sums, pose_weighting
from estimator.pipeline import new_state
from estimator.result import Fix, LightsResult
from estimator.scan_matching.scan_matcher import MatchSettings, Prior, attempt
from estimator.state import State
from tests.estimator.scan_matching.test_icp import WIDE, pair_of
from tests.estimator.world import prior_at
from tools.bench.support.scenes import paper_room

poses = st.tuples(*[st.floats(-5.0, 5.0)] * 2, st.floats(-3.0, 3.0)).map(np.array)
small = st.tuples(*[st.floats(-0.5, 0.5)] * 2, st.floats(-0.5, 0.5)).map(np.array)


def combined(T1: Array, T2: Array, W: Array) -> Array:
    out = np.empty(3)
    pose_weighting.combine(T1, T2, W, out)
    return out


def information(rng: np.random.Generator, scale: float = 1.0) -> Array:
    A = rng.normal(size=(3, 3))
    return np.ascontiguousarray(scale * (A @ A.T + 0.1 * np.eye(3)))


@given(poses, small)
def test_kernels_are_log_and_exp(T: Array, u: Array) -> None:
    moved, back = np.empty(3), np.empty(3)
    pose_weighting.moved(T, u, moved)
    np.testing.assert_allclose(moved[:2], se2.compose(T, se2.exp(u))[:2], atol=1e-12)
    pose_weighting.twist_between(T, moved, back)
    np.testing.assert_allclose(back, u, atol=1e-9)
    pose_weighting.twist_between(T, moved + np.array((0.0, 0.0, 2.0 * np.pi)), back)
    np.testing.assert_allclose(back, u, atol=1e-9)


@given(poses, small)
def test_the_ends_are_the_witnesses(T2: Array, u: Array) -> None:
    T1 = se2.compose(T2, se2.exp(u))
    np.testing.assert_allclose(combined(T1, T2, np.zeros((3, 3)))[:2], T2[:2], atol=1e-12)
    np.testing.assert_allclose(combined(T1, T2, np.eye(3))[:2], T1[:2], atol=1e-9)
    half = combined(T1, T2, 0.5 * np.eye(3))
    np.testing.assert_allclose(se2.log(se2.between(T2, half)), 0.5 * u, atol=1e-9)


def test_the_weight_gives_each_direction_to_who_knows_it() -> None:
    L1, L2, W = np.diag((100.0, 0.01, 50.0)), np.diag((0.0, 1e6, 50.0)), np.empty((3, 3))
    pose_weighting.information_weight(L1, L2, W)
    np.testing.assert_allclose(np.diag(W), (1.0, 0.0, 0.5), atol=1e-6)
    rng = np.random.default_rng(0)
    L1, L2 = information(rng), information(rng)
    pose_weighting.information_weight(L1, L2, W)
    np.testing.assert_allclose((L1 + L2) @ W, L1, atol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_information_turns_with_its_frame(yaw: float) -> None:
    L, out, R = information(np.random.default_rng(1)), np.empty((3, 3)), se2.rotation(yaw)
    pose_weighting.turned(L, yaw, out)
    np.testing.assert_allclose(out, R.T @ L @ R, atol=1e-12)


@given(st.floats(-1e9, 0.0), st.floats(-1e9, 0.0))
def test_the_scalar_weight_is_the_ratio(a: float, b: float) -> None:
    W = np.empty((3, 3))
    pose_weighting.paper_weight(a, b, W)
    w = W[0, 0]
    assert 0.0 <= w <= 1.0
    np.testing.assert_array_equal(W, w * np.eye(3))
    top = max(a, b)
    assert w == pytest.approx(np.exp(a - top) / (np.exp(a - top) + np.exp(b - top)), abs=1e-12)


def test_the_scalar_weight_without_light_or_without_laser() -> None:
    W = np.empty((3, 3))
    pose_weighting.paper_weight(-np.inf, -3.0, W)
    assert W[0, 0] < 1e-300
    pose_weighting.paper_weight(-3.0, -np.inf, W)
    assert W[0, 0] == 1.0


@settings(max_examples=30)
@given(poses, poses, st.integers(2, 8), st.integers(0, 1000))
def test_lamps_seen_from_two_bodies_give_the_relative_pose(ref: Array, new: Array, count: int, seed: int) -> None:
    """T1 "is solved using Eq. 13" on the lamps' coordinates, which is nothing but the two poses' difference."""
    lamps = np.random.default_rng(seed).uniform(-5.0, 5.0, (count, 2))
    p, q = se2.apply(se2.inverse(ref), lamps), se2.apply(se2.inverse(new), lamps)
    T = np.empty(3)
    point_to_point_sums.align(np.ascontiguousarray(q), np.ascontiguousarray(p), T)
    apart = np.hypot(*(lamps - lamps.mean(axis=0)).T).max()
    off = T - se2.between(ref, new)
    off[2] = se2.wrap(off[2])
    np.testing.assert_allclose(off, 0.0, atol=1e-9 / max(apart, 1e-3))


@pytest.mark.jit
def test_the_default_matcher_weighs_as_the_matrix_does() -> None:
    """Its pose with the prediction inside the normal equations, and Eq. 14 after them: the same to first order.

    What remains are pairs and robust weights, which are not the same at the two poses.
    """
    rng, apart = np.random.default_rng(9), []
    for _ in range(5):
        local, view, T, _ = pair_of(paper_room(), WIDE, 0.02, 0.5, rng)
        free = attempt(view, local, prior_at(T, 5.0, 3.0), 50, MatchSettings(settled=0.001))
        u = rng.normal(size=3) * (1e-3, 1e-3, 2e-4)
        first = Prior(se2.compose(free.T, se2.exp(u)), np.diag((3.0, 0.2, 1.0)) * np.diag(free.H))
        pulled = attempt(view, local, first, 50, MatchSettings(settled=0.001))
        L1, L2, W = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        pose_weighting.turned(first.L, free.T[2], L1)
        pose_weighting.turned(free.H, free.T[2], L2)
        pose_weighting.information_weight(L1, L2, W)
        expected = combined(first.T, free.T, W)
        way = np.abs(pulled.T - free.T)
        apart.append(np.abs(pulled.T - expected).max() / way.max())
        assert way.max() > 2e-4
    assert max(apart) < 0.25
    assert np.mean(apart) < 0.12


def gain(state: State, told: LightsResult) -> None:
    """Take in an epoch that has the robot where it is, without wheels."""
    map_odom_filter.gain(state.pose, state.motion, False, (told, np.zeros(3), np.zeros(3)), state.map.next_key)


def test_the_same_light_taken_twice_is_news_once() -> None:
    """The pose takes what links have added, through T_map_odom, within one filter's worth for each stretch of way."""
    state = new_state()
    tie = state.pose.alignment = SurveyAlignment(placed=True, proved=True, fresh=1.0)
    tie.P, tie.X = np.diag((0.04, 0.04, 0.01)), np.zeros((3, 3))
    P = np.diag((0.02, 0.02, 0.005))
    told = LightsResult(0.0, Fix.GOOD, np.zeros(3), P, (), frozenset(), np.linalg.inv(P), np.zeros(3))
    once = copy.deepcopy(state)
    gain(once, told)
    twice = copy.deepcopy(once)
    gain(twice, told)
    assert once.pose.alignment is not None
    assert twice.pose.alignment is not None
    np.testing.assert_allclose(once.pose.alignment.P, np.linalg.inv(np.linalg.inv(tie.P) + np.linalg.inv(P)), rtol=1e-6)
    np.testing.assert_allclose(twice.pose.alignment.P, once.pose.alignment.P, rtol=1e-6)
    tie.P = once.pose.alignment.P.copy()
    gain(state, replace(told, gained=np.zeros((3, 3))))
    np.testing.assert_allclose(tie.P, once.pose.alignment.P, rtol=1e-6)
