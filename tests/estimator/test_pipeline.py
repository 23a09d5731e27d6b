"""A robot in a box room: the step follows it, keeps its word about bad input, and draws the room."""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest

from estimator.measurements import UNLIMITED, Array, Beam, Command, Odometry, Order, Record, Scan
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
