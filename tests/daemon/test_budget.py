"""Caps from measured cost: what gives way first, that map work never starves, that a spike is not a trend."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.budget import (
    FEWEST_CODES,
    FEWEST_ITERATIONS,
    FEWEST_POINTS,
    LONGEST_MAP_WAIT,
    PLAIN_AGO,
    SEARCH_SHARE,
    SEARCH_US,
    FixedBudget,
    MeasuredBudget,
    RecordedBudget,
)
from estimator.records import UNLIMITED, Limits
from estimator.result import MatchResult, Reason, StepResult


def step(iterations: int = 8, queries: int = 1000, keyframe: int = -1, matched: bool = True) -> StepResult:
    zero = np.zeros(3)
    match = MatchResult(zero, np.eye(3), queries, queries, iterations, 0.0, np.ones(3), zero, Reason.CONVERGED)
    return StepResult(
        t_mono=0.0,
        T_odom_base=zero,
        T_map_odom=zero,
        covariance=np.eye(3),
        velocity=zero,
        known_axes=np.ones(3),
        match=match if matched else None,
        keyframe=keyframe,
        loop=None,
        anchor=0,
        T_anchor_base=zero,
        jumps=0,
    )


def learned(per_iteration_us: float, map_us: float = 0.0) -> MeasuredBudget:
    budget = MeasuredBudget()
    for _ in range(20):
        budget.learn(8 * per_iteration_us, UNLIMITED, step())
    for _ in range(20):
        budget.learn(8 * per_iteration_us + map_us, UNLIMITED, step(keyframe=1))
    return budget


def test_before_anything_is_measured_nothing_is_capped() -> None:
    assert MeasuredBudget().limits(10.0) == UNLIMITED


def test_a_quick_machine_is_not_capped() -> None:
    assert learned(100.0, map_us=1000.0).limits(12_500.0) == UNLIMITED


def test_first_map_work_waits() -> None:
    limits = learned(500.0, map_us=9000.0).limits(12_500.0)
    assert (limits.update_map, limits.points) == (False, UNLIMITED.points)
    assert limits.icp_iterations == 25


def test_then_the_scan_is_thinned() -> None:
    limits = learned(4000.0).limits(12_500.0)
    assert limits.points == pytest.approx(1000 * 12_500 / (12 * 4000), abs=2)
    assert limits.icp_iterations >= 12 - 1


def test_the_floor_is_kept_on_a_hopeless_machine() -> None:
    assert learned(1e6, map_us=1e6).limits(1000.0) == Limits(FEWEST_ITERATIONS, FEWEST_POINTS, False)


def test_map_work_never_starves() -> None:
    budget = learned(500.0, map_us=9000.0)
    granted = []
    for _ in range(3 * (LONGEST_MAP_WAIT + 1)):
        limits = budget.limits(12_500.0)
        granted.append(limits.update_map)
        budget.learn(4000.0, limits, step())
    assert granted.count(True) == 3
    assert granted[: LONGEST_MAP_WAIT + 1] == [False] * LONGEST_MAP_WAIT + [True]


def test_one_step_during_which_something_else_ran_changes_nothing() -> None:
    budget = learned(500.0)
    budget.learn(50_000.0, UNLIMITED, step())
    assert budget.limits(12_500.0).icp_iterations == 25


def test_a_machine_that_becomes_slow_is_noticed_within_a_few_cycles_and_a_quick_one_too() -> None:
    budget = learned(500.0)
    for _ in range(3):
        budget.learn(8 * 4000.0, UNLIMITED, step())
    assert budget.limits(12_500.0).points < 400
    for _ in range(60):
        budget.learn(8 * 500.0, UNLIMITED, step())
    assert budget.limits(12_500.0).points == UNLIMITED.points


def test_thinned_scans_still_teach_the_cost_of_full_ones() -> None:
    """Otherwise the caps would swing: thin, quick, full, slow, thin."""
    budget = learned(4000.0)
    for _ in range(50):
        limits = budget.limits(12_500.0)
        part = limits.points / 1000
        budget.learn(8 * 4000.0 * part, limits, step(queries=limits.points))
    assert budget.limits(12_500.0).points == pytest.approx(260, rel=0.1)


def test_steps_without_a_match_teach_nothing() -> None:
    budget = MeasuredBudget()
    budget.learn(1e6, UNLIMITED, step(matched=False))
    budget.learn(1e6, UNLIMITED, step(iterations=0))
    assert budget.limits(10.0) == UNLIMITED


def test_light_is_taken_from_the_budget_and_thins_no_scan_before_its_time() -> None:
    """What a block costs to decode, 4 ms here, is not the iterations' doing."""
    budget = MeasuredBudget()
    for _ in range(40):
        budget.learn(8 * 300.0, UNLIMITED, step())
        budget.learn(8 * 300.0 + 4000.0, UNLIMITED, step(), light=True)
    assert budget.limits(12_500.0).icp_iterations == 41, "300 us each"
    assert budget.limits(12_500.0).points == budget.limits(12_500.0, light=True).points == UNLIMITED.points
    assert budget.limits(12_500.0, light=True).icp_iterations == 28, "8.5 ms are left"
    assert budget.limits(7_000.0, light=True).points < 1000 < budget.limits(7_000.0).points
    budget.learn(8 * 300.0 + 9000.0, UNLIMITED, step(keyframe=1), light=True)
    assert budget.limits(9_000.0).update_map, "map work without light: 5 ms"
    assert not budget.limits(9_000.0, light=True).update_map


def test_where_every_step_has_light_it_is_counted_with_the_iterations() -> None:
    budget = MeasuredBudget()
    for _ in range(PLAIN_AGO + 60):
        budget.learn(8 * 300.0 + 4000.0, UNLIMITED, step(), light=True)
    assert budget.limits(9_600.0, light=True).icp_iterations == 12
    assert budget.limits(8_000.0, light=True).points < 1000, "a machine too slow for both is not left uncapped"
    budget.learn(8 * 300.0, UNLIMITED, step())
    assert budget.limits(9_600.0, light=True).points >= 1000


def test_replay_uses_the_recorded_caps_in_order() -> None:
    first, second = Limits(3, 100, False), Limits(50, 1000, True)
    budget = RecordedBudget([first, second])
    assert [budget.limits(1.0), budget.limits(1.0)] == [first, second]
    with pytest.raises(LookupError, match="more steps than were recorded"):
        budget.limits(1.0)


def test_fixed_caps_never_change() -> None:
    budget = FixedBudget(Limits(5, 6, False))
    budget.learn(1e9, UNLIMITED, step())
    assert budget.limits(1.0) == Limits(5, 6, False)


def test_the_search_for_lamps_gets_a_millisecond_and_no_more_than_its_share() -> None:
    budget = MeasuredBudget()
    assert budget.limits(12_500.0).codes == UNLIMITED.codes, "nothing is known of its cost"
    budget.learn_code(20.0)
    assert budget.limits(12_500.0).codes == SEARCH_US / 20.0
    assert budget.limits(5_000.0).codes == SEARCH_SHARE * 5_000.0 / 20.0
    assert budget.limits(100.0).codes == FEWEST_CODES, "however slow, it comes to an end"
    budget.learn_code(5.0)
    assert budget.limits(12_500.0).codes == UNLIMITED.codes
    for _ in range(20):
        budget.learn(8 * 500.0, UNLIMITED, step())
    budget.learn_code(20.0)
    assert budget.limits(12_500.0).codes == SEARCH_US / 20.0
