"""The step: its order, its contract of results, and degradation by level."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from estimator.measurements import (
    UNLIMITED,
    Array,
    Beam,
    Command,
    DegradationLevel,
    Limits,
    Odometry,
    Order,
    Record,
    Scan,
)
from estimator.numerics import se2
from estimator.pipeline import Settings, State, keyframe_poses, new_state, render_map, step
from estimator.result import Reason, StepResult

BEARING = np.radians(np.linspace(-135.0, 135.0, 541))
LOW, HIGH = np.array((-4.0, -3.0)), np.array((6.0, 5.0))


def room_ranges(T: Array) -> Array:
    """Distance to the walls of a box for each beam."""
    direction = np.column_stack((np.cos(BEARING + T[2]), np.sin(BEARING + T[2])))
    direction = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    to_wall = np.where(direction > 0, HIGH - T[:2], LOW - T[:2]) / direction
    return np.asarray(to_wall.min(axis=1))


def scan_at(T: Array, t: float, seq: int, noise: np.random.Generator | None = None) -> Scan:
    ranges = room_ranges(T)
    if noise is not None:
        ranges = ranges + noise.normal(0.0, 0.01, len(ranges))
    kind = np.full(len(ranges), Beam.HIT, np.uint8)
    return Scan(t, t, seq, np.zeros(3), BEARING, ranges, kind, 0.01)


def path(n: int) -> list[Array]:
    a = np.linspace(0.0, 2.0 * np.pi, n)
    return [np.array((2.0 * np.sin(v), 1.5 - 1.5 * np.cos(v), 0.5 * np.sin(2.0 * v))) for v in a]


def drive(state: State, *, odometry: bool, n: int = 300) -> tuple[list[Array], list[StepResult]]:
    noise = np.random.default_rng(1)
    truth = path(n)
    results = []
    for k, T in enumerate(truth):
        records: list[Record] = [scan_at(T, 0.05 * k, k, noise)]
        if odometry and k:
            delta = se2.between(truth[k - 1], T) * (1.03, 1.03, 0.97)
            records.append(Odometry(0.05 * (k - 1), 0.05 * k, delta))
        results.append(step(state, records, UNLIMITED))
    return truth, results


@cache
def driven_once(n: int) -> tuple[State, Array]:
    """Without the compiler a step takes a quarter of a second: several tests begin where this has ended."""
    state = new_state(Settings())
    return state, drive(state, odometry=True, n=n)[0][-1]


def driven(n: int) -> tuple[State, Array]:
    """A state of its own after ``n`` scans, and where the robot is."""
    state, T = driven_once(n)
    return deepcopy(state), T


@pytest.mark.jit
@pytest.mark.parametrize("odometry", [True, False])
def test_follows_the_robot(odometry: bool) -> None:
    state = new_state(Settings(history=True))
    truth, results = drive(state, odometry=odometry)
    error = np.array([se2.between(T, r.T_odom_base) for T, r in zip(truth, results, strict=True)])
    assert np.abs(error[:, :2]).max() < 0.02
    assert np.abs(error[:, 2]).max() < np.radians(0.4)
    assert all(r.match is not None and r.match.ok for r in results[1:])
    poses = keyframe_poses(state)
    for r in results:
        again = se2.compose(poses[r.anchor], r.T_anchor_base)
        np.testing.assert_allclose(again, se2.compose(r.T_map_odom, r.T_odom_base), atol=1e-9)


@pytest.mark.jit
def test_map_shows_the_walls_and_the_free_floor() -> None:
    state = new_state(Settings())
    drive(state, odometry=True)
    grid = render_map(state, 0.05)
    rows, columns = np.nonzero(grid.log_odds > 1.0)
    xy = grid.origin + (np.column_stack((columns, rows)) + 0.5) * grid.resolution
    to_wall = np.minimum(np.abs(xy - LOW).min(axis=1), np.abs(xy - HIGH).min(axis=1))
    assert len(xy) > 400
    assert np.percentile(to_wall, 95) < 0.08
    inside = ((np.zeros(2) - grid.origin) / grid.resolution).astype(int)
    assert grid.log_odds[inside[1], inside[0]] < -1.0


def bad(kind: str) -> Scan:
    n = {"empty": 0, "three": 3}.get(kind, len(BEARING))
    ranges = np.full(n, {"nan": np.nan, "negative": -1.0, "infinite": np.inf}.get(kind, 2.0))
    beam = np.full(n, Beam.NONE if kind == "invalid" else Beam.HIT, np.uint8)
    bearing = np.zeros(n) if kind == "identical" else BEARING[:n]
    return Scan(16.0, 16.0, 999, np.zeros(3), bearing, ranges, beam, 0.01)


@pytest.mark.parametrize("kind", ["empty", "invalid", "three", "identical", "nan", "negative", "infinite"])
@pytest.mark.parametrize("fresh", [True, False])
def test_bad_scans_say_why_and_move_nothing(kind: str, fresh: bool) -> None:
    state, truth = (new_state(Settings()), np.zeros(3)) if fresh else driven(30)
    before = state.motion.T_odom_base.copy()
    records: list[Record] = [bad(kind)]
    if not fresh:
        records.insert(0, Odometry(1.45, 16.0, np.zeros(3)))
    result = step(state, records, UNLIMITED)
    assert result.match is not None
    if not result.match.ok:
        few = (Reason.TOO_FEW_POINTS, Reason.TOO_FEW_PAIRS)
        assert result.match.reason in (*few, Reason.NO_MAP, Reason.REJECTED, Reason.MALFORMED)
        np.testing.assert_allclose(result.T_odom_base, before, atol=1e-9)
    assert np.abs(se2.between(truth, result.T_odom_base)[:2]).max() < 0.03
    assert np.isfinite(result.covariance).all()
    if not fresh:
        again = step(state, [scan_at(truth, 16.1, 1000)], UNLIMITED)
        assert again.match is not None
        assert again.match.ok


def test_set_pose_moves_the_map_and_counts_a_jump() -> None:
    state, _ = driven(60)
    before = state.motion.T_odom_base.copy()
    wanted = np.array((10.0, -3.0, 1.0))
    result = step(state, [Command(3.1, Order.SET_POSE, wanted)], UNLIMITED)
    np.testing.assert_allclose(se2.compose(result.T_map_odom, result.T_odom_base), wanted, atol=1e-9)
    np.testing.assert_array_equal(result.T_odom_base, before)
    assert result.jumps == 1
    np.testing.assert_allclose(
        se2.compose(keyframe_poses(state)[result.anchor], result.T_anchor_base), wanted, atol=1e-9
    )


def test_reset_forgets_the_map() -> None:
    state, truth = driven(60)
    result = step(state, [Command(3.1, Order.RESET)], UNLIMITED)
    np.testing.assert_allclose(se2.compose(result.T_map_odom, result.T_odom_base), np.zeros(3), atol=1e-12)
    assert list(keyframe_poses(state)) == [0]
    again = step(state, [scan_at(truth, 3.2, 1000)], UNLIMITED)
    assert again.match is not None
    assert again.match.reason is Reason.NO_MAP
    assert again.keyframe > 0


PERIOD = 0.1
FAR = 12.0


def corridor(t: float, seq: int) -> Scan:
    """A plain corridor along the lidar's x axis, 2 m wide, whose ends are out of sight."""
    side = np.abs(np.sin(BEARING))
    reach = 1.0 / np.maximum(side, 1e-9) + np.random.default_rng(seq).normal(0.0, 0.01, len(BEARING))
    kind = np.where(reach < FAR, np.uint8(Beam.HIT), np.uint8(Beam.NONE))
    return Scan(t, t, seq, np.zeros(3), BEARING, reach, kind, 0.01)


def known(yaw: float) -> Array:
    """Axes said to be known in the corridor when a person has said that it lies at ``yaw`` in the map."""
    state = new_state()
    for seq in range(5):
        step(state, [corridor(PERIOD * seq, seq)], UNLIMITED)
    pose = np.array((3.0, 4.0, yaw))
    step(state, [Command(5 * PERIOD, Order.SET_POSE, pose)], UNLIMITED)
    result = step(state, [corridor(6 * PERIOD, 6)], UNLIMITED)
    assert result.match is not None
    assert result.match.ok
    return result.known_axes


def test_known_axes_are_those_of_the_map_frame() -> None:
    assert known(0.0).tolist() == [0.0, 1.0, 1.0]
    assert known(0.5 * math.pi).tolist() == [1.0, 0.0, 1.0], "the corridor runs along y of the map"
    assert known(0.25 * math.pi).tolist() == [0.0, 0.0, 1.0], "neither axis alone says where along the corridor it is"


def test_a_result_stays_as_it_was() -> None:
    state = new_state()
    first = None
    before: dict[str, Array] = {}
    for seq in range(8):
        moved = Odometry(PERIOD * (seq - 1), PERIOD * seq, np.array((0.02 * seq, 0.0, 0.0)))
        result = step(state, [corridor(PERIOD * seq, seq), moved], UNLIMITED)
        if first is None:
            first = result
            before = {name: np.copy(getattr(result, name)) for name in ("T_odom_base", "velocity", "covariance")}
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(first, name), value, err_msg=name)


@pytest.mark.parametrize("silence", [3.0, 15.0, 60.0])
def test_a_gap_that_nothing_witnessed_leaves_a_wide_uncertainty(silence: float) -> None:
    state = new_state()
    for seq in range(10):
        step(state, [corridor(PERIOD * seq, seq)], UNLIMITED)
    later = step(state, [corridor(PERIOD * 10 + silence, 10)], UNLIMITED)
    along, across = np.sqrt(np.diag(later.covariance))[:2]
    assert along > 0.3 * (silence - 1.0), "a robot may have driven on at walking pace"
    assert across < max(0.05, 2e-3 * along), "the walls say where it is across, a tenth of a degree left open"
    assert np.isfinite(later.T_odom_base).all()


def test_a_gap_that_odometry_bridged_does_not() -> None:
    state = new_state()
    for seq in range(10):
        step(state, [corridor(PERIOD * seq, seq)], UNLIMITED)
    end = 9 * PERIOD
    for _ in range(600):
        step(state, [Odometry(end, end + 0.05, np.array((0.02, 0.0, 0.0)))], UNLIMITED)
        end += 0.05
    later = step(state, [corridor(end, 10)], UNLIMITED)
    assert math.sqrt(later.covariance[0, 0]) < 0.5, "12 m at a few per cent"
    assert se2.between(np.zeros(3), later.T_odom_base)[0] == pytest.approx(12.0, abs=0.1)


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
