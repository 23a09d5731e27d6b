"""A scan that comes late is matched where the robot was when it was true, and corrects where it is now."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion import map_odom_filter, motion_model, out_of_sequence
from estimator.fusion.map_pose import SurveyAlignment
from estimator.fusion.motion_history import KEPT_S, Trail, made
from estimator.fusion.protection_level import on_wheels
from estimator.measurements import UNLIMITED, Array, Odometry, Record
from estimator.numerics import se2
from estimator.numerics.symmetric3 import invert3
from estimator.pipeline import State, new_state, step
from estimator.result import Fix, LightsResult, Reason, StepResult
from tests.estimator.test_pipeline import path, scan_at

PERIOD_S = 0.05
TRUTH = path(300)


def at(state: State, k: int, late: int = 0, wheels: float = 1.02) -> StepResult:
    """A step at which odometry is new and the scan ``late`` periods old."""
    records: list[Record] = [scan_at(TRUTH[k - late], PERIOD_S * (k - late), k - late, np.random.default_rng(k - late))]
    if k:
        delta = se2.between(TRUTH[k - 1], TRUTH[k]) * (wheels, 1.0, 1.0)
        records.append(Odometry(PERIOD_S * (k - 1), PERIOD_S * k, delta))
    return step(state, records, UNLIMITED)


def only_wheels(state: State, k: int) -> None:
    step(state, [Odometry(PERIOD_S * (k - 1), PERIOD_S * k, se2.between(TRUTH[k - 1], TRUTH[k]))], UNLIMITED)


def off(result: StepResult, k: int) -> float:
    return float(np.hypot(*se2.between(TRUTH[k], result.T_odom_base)[:2]))


@pytest.mark.jit
@pytest.mark.parametrize("late", [3, 6, 30])
def test_late_scans_hold_the_pose_where_it_is_now(late: int) -> None:
    """0.15, 0.3 and 1.5 s: what stays is the error of the wheels since (2 %), not the way driven since."""
    state = new_state()
    for k in range(60):
        at(state, k)
    for k in range(60, 60 + late):  # the delay comes: for so long nothing arrives but odometry
        only_wheels(state, k)
    results = {k: at(state, k, late) for k in range(60 + late, 220)}
    assert all(result.match is not None and result.match.ok for result in results.values())
    way = max(float(np.hypot(*se2.between(TRUTH[k - late], TRUTH[k])[:2])) for k in results)
    assert max(off(result, k) for k, result in results.items()) < 0.02 + 0.04 * way
    assert {result.t_mono for result in results.values()} == {PERIOD_S * k for k in results}, "the pose is of now"
    assert state.matching.restarts == 0
    assert any(result.keyframe >= 0 for result in results.values()), "and the map goes on"
    for k, result in results.items():
        error = se2.between(TRUTH[k], result.T_odom_base)[:2]
        sigma = np.sqrt(np.linalg.eigvalsh(result.covariance[:2, :2]).max())
        assert np.hypot(*error) < 4.0 * sigma


@pytest.mark.jit
def test_a_late_scan_is_worth_less_than_one_in_time() -> None:
    states = new_state(), new_state()
    for k in range(60):
        for state in states:
            at(state, k)
    for k in range(60, 66):
        only_wheels(states[0], k)
    in_time = at(states[0], 66)
    for k in range(60, 66):
        only_wheels(states[1], k)
    late = at(states[1], 66, 6)
    assert np.trace(late.covariance[:2, :2]) > np.trace(in_time.covariance[:2, :2])
    assert np.linalg.eigvalsh(states[1].motion.P).min() > 0.0


@pytest.mark.jit
def test_a_scan_older_than_what_is_remembered_is_not_matched() -> None:
    state = new_state()
    for k in range(60):
        at(state, k)
    late = round((KEPT_S + 0.5) / PERIOD_S)
    for k in range(60, 60 + late):
        only_wheels(state, k)
    before = state.motion.T_odom_base
    result = at(state, 60 + late, late)
    assert result.match is not None
    assert result.match.reason is Reason.LATE
    assert np.hypot(*se2.between(before, result.T_odom_base)[:2]) < 0.05, "and moves nothing"
    assert state.matching.failures == 0


def lit(state: State, follows: bool) -> None:
    """An epoch of light at the present pose: followed, or its information taken."""
    T, P = state.motion.T_odom_base, np.diag((0.03**2, 0.03**2, 0.02**2))
    told = LightsResult(0.0, Fix.GOOD, T, P, (), frozenset(), 0.9 * invert3(P), np.zeros(3))
    if follows:
        map_odom_filter.follow(state.pose, state.motion, told, T)
    else:
        map_odom_filter.gain(
            state.pose, state.motion, on_wheels(state.light), (told, T, np.zeros(3)), state.map.next_key
        )


def least(state: State) -> float:
    """Least eigenvalue of the correlation of both errors, the tie's and the pose's."""
    tie, moving = state.pose.alignment, state.motion
    assert tie is not None
    joint = np.block([[tie.P, tie.X], [tie.X.T, moving.P]])
    scale = np.sqrt(np.diag(joint))
    return float(np.linalg.eigvalsh(joint / np.outer(scale, scale)).min())


@pytest.mark.parametrize("epochs", [{}, {9: False}, {9: False, 12: False}, {12: True}, {12: True, 15: False}])
def test_what_light_has_mended_is_not_taken_out_of_the_tie_for_a_late_scan(epochs: dict[int, bool]) -> None:
    """Scans held up for seconds, light meanwhile: of the error of then there is what light has left, never less than 0.

    Else a match of then would move the map against its own correction, and by many times that.
    """
    state = new_state()
    moving, tie = state.motion, SurveyAlignment(placed=True, proved=True, t_match=0.0)
    moving.t_mono, moving.P, state.pose.alignment = 0.0, np.diag((0.01, 0.01, 0.003)) ** 2, tie
    tie.P, tie.X = np.diag((0.03, 0.03, 0.01)) ** 2 + moving.P, moving.P.copy()
    then: Array = np.zeros((3, 3))
    for k in range(20):
        before = moving.T_odom_base, moving.P, moving.t_mono
        delta = np.array((0.05, 0.0, 0.004))
        motion_model.on_odometry(moving, Odometry(PERIOD_S * k, PERIOD_S * (k + 1), delta), motion_model.MotionNoise())
        map_odom_filter.on_motion(state.pose, state.motion, *before)
        if k == 5:
            then = moving.P.copy()
        if k in epochs:
            lit(state, epochs[k])
    assert least(state) > 0.0
    now = tie.P.copy(), tie.X.copy(), moving.P.copy()
    scan = replace(scan_at(TRUTH[0], 0.0, 0, np.random.default_rng(0)), t_begin=5 * PERIOD_S, t_end=6 * PERIOD_S)
    ahead = out_of_sequence.go_back(state.pose, moving, scan)
    assert ahead.known
    assert np.allclose(moving.P, then, rtol=1e-6, atol=1e-12)
    share = np.diag(tie.X @ np.linalg.inv(moving.P))
    if True in epochs.values():
        assert share == pytest.approx(np.zeros(3), abs=1e-6)
    elif epochs:
        assert np.all((share > 0.1) & (share < 0.95))
    else:
        assert share == pytest.approx(np.ones(3), abs=1e-6)
    assert least(state) > 0.0
    out_of_sequence.come_again(state.pose, moving, ahead)
    for there, was in zip((tie.P, tie.X, moving.P), now, strict=True):
        assert np.allclose(there, was, rtol=1e-6, atol=1e-12)


def test_the_trail_tells_the_way_since_any_instant() -> None:
    trail, twist = Trail(), np.array((0.5, 0.0, 0.4))
    for k in range(1000):
        trail.add(0.001 * k, 0.001 * (k + 1), se2.exp(twist * 0.001), np.full(3, 1e-6))
    way = trail.since(0.7005)
    assert way is not None
    delta, Q = made(way)
    assert np.allclose(delta, se2.exp(twist * 0.2995), atol=1e-9)
    assert Q[2, 2] == pytest.approx(299.5e-6)
    assert len(trail.stretches) < 110, "readings are put together"


def test_the_trail_is_bounded_and_says_where_it_ends() -> None:
    trail = Trail()
    for k in range(1000):
        trail.add(0.05 * k, 0.05 * (k + 1), np.array((0.01, 0.0, 0.0)), np.zeros(3))
    assert len(trail.stretches) <= KEPT_S / 0.05 + 2
    assert trail.since(50.0 - KEPT_S - 0.2) is None
    assert trail.since(50.0 - KEPT_S + 0.1) is not None
    trail.forget(50.0)
    assert trail.since(49.9) is None


def test_what_was_carried_ahead_is_taken_back() -> None:
    """Odometry tells later what the velocity had guessed."""
    trail = Trail()
    trail.add(0.0, 1.0, np.array((1.0, 0.0, 0.0)), np.full(3, 1.0))
    trail.take_back(0.4)
    trail.add(0.4, 1.0, np.array((0.3, 0.0, 0.0)), np.full(3, 0.3))
    way = trail.since(0.2)
    assert way is not None
    delta, Q = made(way)
    assert delta[0] == pytest.approx(0.5)
    assert Q[0, 0] == pytest.approx(0.5)
