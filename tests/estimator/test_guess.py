"""A stretch of way that nothing tells, without wheels: what it leaves in doubt."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator import guess
from estimator.absolute import Absolute
from estimator.guess import Guess, loose_direction
from estimator.records import Array
from estimator.state import State, new_state

HOLDS = np.diag((1e5, 1e6, 1e6))
BETWEEN_WALLS = np.diag((0.0, 1e6, 1e6))
"""Along x nothing holds."""
STEP_S = 0.1


def turned(H: Array, yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    return np.asarray(R @ H @ R.T)


def driving(yaw: float = 0.0, speed: float = 0.6, before: Array | None = None) -> State:
    state = new_state()
    state.fused.t_mono, state.fused.T_odom_base = 10.0, np.array((1.0, 2.0, yaw))
    state.fused.velocity, state.fused.velocity_variance = np.array((speed, 0.0, 0.0)), np.full(3, 1e-4)
    state.P_anchor = np.diag((1e-4, 1e-4, 1e-6)) if before is None else before.copy()
    return state


def go(state: State, H: Array, seconds: float, speed: float = 0.6) -> None:
    """Matches with that information, every tenth of a second."""
    yaw = float(state.fused.T_odom_base[2])
    for _ in range(round(seconds / STEP_S)):
        state.fused.t_mono += STEP_S
        step = STEP_S * speed * np.array((math.cos(yaw), math.sin(yaw), 0.0))
        state.fused.T_odom_base = state.fused.T_odom_base + step
        guess.on_match(state, H, STEP_S)


def sigmas(state: State) -> tuple[float, float]:
    """Along x and y."""
    return math.sqrt(state.P_anchor[0, 0]), math.sqrt(state.P_anchor[1, 1])


def test_half_a_second_is_carried_and_then_half_a_metre_a_second_is_in_doubt() -> None:
    state = driving()
    go(state, BETWEEN_WALLS, 0.5)
    assert sigmas(state) == pytest.approx((0.01, 0.01))
    go(state, BETWEEN_WALLS, 2.0)
    assert sigmas(state) == pytest.approx((1.0, 0.01), rel=1e-3)
    assert state.atlas.C[0, 0] == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.8])
def test_the_same_speed_before_and_after_a_short_stretch_tells_most_of_it(yaw: float) -> None:
    """A second: at most 1 m/s^2 for half of it and back is 0.25 m, two deviations; as a guess it was 0.25 for one."""
    state = driving(yaw)
    go(state, turned(BETWEEN_WALLS, yaw), 1.0)
    along = np.array((math.cos(yaw), math.sin(yaw)))
    before = math.sqrt(along @ state.P_anchor[:2, :2] @ along)
    go(state, turned(HOLDS, yaw), 0.3)
    after = math.sqrt(along @ state.P_anchor[:2, :2] @ along)
    assert before == pytest.approx(0.25, abs=0.002)
    assert after == pytest.approx(0.126, abs=0.002)
    assert np.linalg.eigvalsh(state.P_anchor)[0] > 0.0
    assert state.guess.seconds == 0.0


def test_another_speed_after_it_leaves_the_way_at_the_mean_of_both_in_doubt() -> None:
    """0.3 m/s slower: 0.15 m from the way at the speed of before."""
    state = driving()
    go(state, BETWEEN_WALLS, 1.0)
    go(state, HOLDS, 0.3, speed=0.3)
    assert sigmas(state)[0] == pytest.approx(math.hypot(0.126, 0.15), abs=0.002)
    stopped = driving()
    go(stopped, BETWEEN_WALLS, 1.0)
    go(stopped, HOLDS, 0.3, speed=0.0)
    assert sigmas(stopped)[0] == pytest.approx(0.25, abs=0.002), "never more than the guess"


def test_after_a_long_stretch_two_speeds_tell_nothing() -> None:
    state = driving()
    go(state, BETWEEN_WALLS, 6.0)
    go(state, HOLDS, 0.5)
    assert sigmas(state)[0] == pytest.approx(2.75, abs=0.01)


def test_a_speed_is_not_told_by_one_match_and_what_was_loose_again_is_another_stretch() -> None:
    state = driving()
    go(state, BETWEEN_WALLS, 1.0)
    go(state, HOLDS, 0.1)
    assert sigmas(state)[0] == pytest.approx(0.25, abs=0.002)
    go(state, BETWEEN_WALLS, 0.2)
    go(state, HOLDS, 1.0)
    assert sigmas(state)[0] == pytest.approx(0.25, abs=0.002)


@pytest.mark.parametrize("what", ["told", "placed", "turned", "wheels"])
def test_what_was_added_stays_where_something_else_has_told_the_place_since(what: str) -> None:
    state = driving()
    go(state, BETWEEN_WALLS, 0.8)
    if what == "told":  # a loop, say
        state.P_anchor = np.diag((4e-4, 4e-4, 1e-6))
        state.guess.stays()
    elif what == "placed":
        state.absolute = Absolute(placed=True)
    elif what == "wheels":
        state.fused.odometry = True
    go(state, turned(BETWEEN_WALLS, 0.5 if what == "turned" else 0.0), 0.2)
    before = state.P_anchor.copy()
    go(state, HOLDS, 0.5)
    assert (state.P_anchor == before).all()
    assert state.guess.seconds == 0.0


def test_a_direction_is_loose_by_what_is_left_of_it_without_the_heading() -> None:
    assert loose_direction(HOLDS) is None
    along = loose_direction(turned(BETWEEN_WALLS, 0.3))
    assert along is not None
    assert abs(along @ np.array((math.cos(0.3), math.sin(0.3)))) == pytest.approx(1.0)
    lever = BETWEEN_WALLS.copy()
    lever[0, 0], lever[0, 2], lever[2, 0] = 1e4, 1e5, 1e5  # all of it is the heading's: 1e4 - 1e5^2 / 1e6
    assert loose_direction(lever) is not None
    assert Guess().along is None
