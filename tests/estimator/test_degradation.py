"""What a step leaves out on each level, and that it takes everything up again afterwards."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.measurements import UNLIMITED, Array, DegradationLevel, Limits, Odometry, Record
from estimator.numerics import se2
from estimator.pipeline import State, new_state, step
from estimator.result import Reason, StepResult
from tests.estimator.test_pipeline import path, scan_at

pytestmark = pytest.mark.jit

TRUTH = path(300)


def at(state: State, k: int, limits: Limits, odometry: bool = True) -> StepResult:
    records: list[Record] = [scan_at(TRUTH[k], 0.05 * k, k, np.random.default_rng(k))]
    if odometry and k:
        records.append(Odometry(0.05 * (k - 1), 0.05 * k, se2.between(TRUTH[k - 1], TRUTH[k]) * (1.02, 1.0, 1.0)))
    return step(state, records, limits)


def off(result: StepResult, T: Array) -> float:
    return float(np.hypot(*se2.between(T, result.T_odom_base)[:2]))


@pytest.mark.parametrize("level", [DegradationLevel.NO_MAP, DegradationLevel.CARRIED])
def test_no_keyframe_and_no_job_comes_of_a_step_without_map_work(level: DegradationLevel) -> None:
    state = new_state()
    for k in range(20):
        at(state, k, UNLIMITED)
    before, map_before = len(state.map.keyframes), state.matching.local_map
    left_out = [at(state, k, replace(UNLIMITED, level=level)) for k in range(20, 80)]
    assert all(result.keyframe < 0 and not result.jobs for result in left_out)
    assert len(state.map.keyframes) == before
    assert state.matching.local_map is map_before
    assert any(at(state, k, UNLIMITED).keyframe >= 0 for k in range(80, 100))


def test_without_map_work_scans_still_hold_the_pose() -> None:
    state = new_state()
    for k in range(20):
        at(state, k, UNLIMITED)
    results = [at(state, k, replace(UNLIMITED, level=DegradationLevel.NO_MAP)) for k in range(20, 60)]
    assert all(result.match is not None and result.match.ok for result in results)
    assert max(off(result, TRUTH[k + 20]) for k, result in enumerate(results)) < 0.02


def test_carried_by_the_wheels_scans_are_passed_over_and_fit_again_afterwards() -> None:
    state = new_state()
    for k in range(40):
        at(state, k, UNLIMITED)
    results = [at(state, k, replace(UNLIMITED, level=DegradationLevel.CARRIED)) for k in range(40, 140)]
    assert {result.match and result.match.reason for result in results} == {Reason.PASSED_OVER}
    assert off(results[-1], TRUTH[139]) > 0.02, "wheels that count 2 % too far carry the pose, and nothing corrects it"
    grown = np.diag(results[-1].covariance) - np.diag(results[0].covariance)
    assert (grown[:2] > 0.0).all(), "and it says so"
    again = [at(state, k, UNLIMITED) for k in range(140, 150)]
    assert again[0].match is not None
    assert again[0].match.ok
    assert again[-1].anew == 0
    assert off(again[-1], TRUTH[149]) < 0.02


def test_carried_by_nothing_the_velocity_dies() -> None:
    state = new_state()
    for k in range(40):
        at(state, k, UNLIMITED, odometry=False)
    speed = [
        np.hypot(*at(state, k, replace(UNLIMITED, level=DegradationLevel.CARRIED), False).velocity[:2])
        for k in range(40, 70)
    ]
    assert speed[0] > 0.1
    assert speed[-1] < 0.01


def test_thinned_is_everything_within_its_caps() -> None:
    one, other = new_state(), new_state()
    caps = replace(UNLIMITED, icp_iterations=4, points=200)
    for k in range(60):
        a, b = at(one, k, caps), at(other, k, replace(caps, level=DegradationLevel.THINNED))
        assert np.array_equal(a.T_odom_base, b.T_odom_base)
        assert a.keyframe == b.keyframe
