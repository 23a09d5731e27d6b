"""The cycle's budget, and the levels of degradation where it does not suffice."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.runtime.budget import (
    COARSE,
    DENSE,
    ENOUGH_ITERATIONS,
    FEWEST_CODES,
    FEWEST_POINTS,
    FIXED,
    LONGEST_MAP_WAIT,
    PROBE_EVERY,
    PROBES,
    SEARCH_SHARE,
    SEARCH_US,
    FixedBudget,
    MeasuredBudget,
    RecordedBudget,
    Spent,
    passes,
)
from daemon.runtime.degradation import LONGEST, MANY, PATIENCE, RECENT, Degradation
from estimator.measurements import UNLIMITED, DegradationLevel, Limits
from estimator.result import MatchResult, Reason, StepResult
from estimator.scan_matching.scan_matcher import MatchSettings


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


BUDGET_US = 12_500.0


def spent(match_us: float, light: bool = False, **more: float) -> Spent:
    return Spent({"match": match_us} | more, 1e9, light)


def match_us(pass_us: float, points: int = 1000) -> float:
    """What eight iterations take."""
    return pass_us * (FIXED + passes(8, points))


def learned(pass_us: float, map_us: float = 0.0, light_us: float = 0.0) -> MeasuredBudget:
    """``pass_us``: of one point through one iteration."""
    budget = MeasuredBudget()
    for _ in range(20):
        budget.learn(spent(match_us(pass_us)), UNLIMITED, step())
        budget.learn(spent(match_us(pass_us), lights=light_us, light=True), UNLIMITED, step())
    for _ in range(20):
        budget.learn(spent(match_us(pass_us), map=map_us), UNLIMITED, step(keyframe=1))
    return budget


def test_before_anything_is_measured_nothing_is_capped() -> None:
    assert MeasuredBudget().limits(10.0) == UNLIMITED


def test_a_quick_machine_is_not_capped() -> None:
    assert learned(0.1, map_us=1000.0).limits(BUDGET_US) == UNLIMITED


def test_first_the_scan_is_thinned_and_map_work_goes_on() -> None:
    limits = learned(1.0, map_us=3000.0).limits(BUDGET_US)
    assert (limits.level, limits.update_map) == (DegradationLevel.THINNED, True)
    assert limits.points == pytest.approx((9500 - FIXED) / ENOUGH_ITERATIONS, abs=2)
    assert limits.icp_iterations == ENOUGH_ITERATIONS


def test_what_is_not_the_iterations_doing_is_no_reason_to_cut_them() -> None:
    """An emulated processor: 25 ms a match, nearly all of it beside the iterations; 100 ms are there."""
    budget = MeasuredBudget()
    for _ in range(20):
        budget.learn(spent(25_000.0, map=19_000.0, judge=5_000.0), UNLIMITED, step(1, queries=181, keyframe=1))
    assert budget.limits(100_000.0, carrier=True) == UNLIMITED
    for k in range(40):
        limits = budget.limits(100_000.0, carrier=True)
        judge_us = 200_000.0 if k % 3 == 2 else 10.0  # another program
        budget.learn(Spent({"match": 25_000.0, "judge": judge_us}, 100_000.0), limits, step(1, queries=181))
    assert budget.limits(100_000.0, carrier=True).level is DegradationLevel.FULL, (
        "there is nothing to be had by matching less"
    )


@pytest.mark.parametrize(
    ("share", "level"),
    [
        (1.3, DegradationLevel.FULL),
        (1.0, DegradationLevel.THINNED),
        (0.8, DegradationLevel.NO_MAP),
        (0.3, DegradationLevel.CARRIED),
    ],
)
def test_a_match_that_nearly_fits_is_made(share: float, level: DegradationLevel) -> None:
    """``share``: what there is, of what a match takes. More than half of the period is no lost scan yet."""
    budget = learned(1.0)
    limits = [budget.limits(share * match_us(1.0), carrier=True) for _ in range(PROBES + 1)][-1]
    assert limits.level is level
    assert limits.icp_iterations >= ENOUGH_ITERATIONS, "the pose converges"


def test_then_map_work_waits() -> None:
    limits = learned(0.8, map_us=9000.0).limits(BUDGET_US)
    assert (limits.level, limits.update_map) == (DegradationLevel.NO_MAP, False)
    assert (limits.icp_iterations, limits.points) == (32, UNLIMITED.points), "all that is left is for matching"


def test_last_the_laser_is_left_out_where_something_else_carries_the_pose() -> None:
    limits = learned(1e6, map_us=1e6).limits(1000.0, carrier=True)
    assert (limits.level, limits.update_map) == (DegradationLevel.NO_MAP, False), "a trial"
    budget = learned(1e6, map_us=1e6)
    levels = [budget.limits(1000.0, carrier=True).level for _ in range(2 * PROBE_EVERY)]
    assert levels.count(DegradationLevel.CARRIED) == 2 * (PROBE_EVERY - PROBES)
    assert levels.count(DegradationLevel.NO_MAP) == 2 * PROBES, (
        "now and then a scan is matched, to learn whether there is time"
    )


def test_the_floor_is_kept_on_a_hopeless_machine_where_nothing_else_carries_the_pose() -> None:
    limits = learned(1e6, map_us=1e6).limits(1000.0)
    assert limits == Limits(ENOUGH_ITERATIONS, FEWEST_POINTS, False, level=DegradationLevel.NO_MAP)


def test_map_work_never_starves() -> None:
    budget = learned(0.8, map_us=9000.0)
    granted = []
    for _ in range(3 * (LONGEST_MAP_WAIT + 1)):
        limits = budget.limits(BUDGET_US)
        granted.append(limits.update_map)
        budget.learn(spent(match_us(0.8)), limits, step())
    assert granted.count(True) == 3
    assert granted[: LONGEST_MAP_WAIT + 1] == [False] * LONGEST_MAP_WAIT + [True]


def test_one_step_during_which_something_else_ran_changes_nothing() -> None:
    budget = learned(0.8)
    budget.learn(spent(50_000.0), UNLIMITED, step())
    assert budget.limits(BUDGET_US).icp_iterations == 32


def test_a_machine_that_becomes_slow_is_noticed_within_a_few_cycles_and_a_quick_one_too() -> None:
    budget = learned(0.8)
    for _ in range(3):
        budget.learn(spent(match_us(1.3)), UNLIMITED, step())
    assert budget.limits(BUDGET_US).points < 500
    for _ in range(60):
        budget.learn(spent(match_us(0.8)), UNLIMITED, step())
    assert budget.limits(BUDGET_US).points == UNLIMITED.points


def test_thinned_scans_still_teach_the_cost_of_full_ones() -> None:
    """Otherwise the caps would swing: thin, quick, full, slow, thin."""
    budget = learned(1.3)
    for _ in range(50):
        limits = budget.limits(BUDGET_US)
        budget.learn(spent(match_us(1.3, limits.points)), limits, step(queries=limits.points))
    assert budget.limits(BUDGET_US).points == pytest.approx((BUDGET_US / 1.3 - FIXED) / 12, rel=0.1)


def test_steps_without_a_match_teach_nothing() -> None:
    budget = MeasuredBudget()
    budget.learn(spent(1e6), UNLIMITED, step(matched=False))
    budget.learn(spent(1e6), UNLIMITED, step(iterations=0))
    assert budget.limits(10.0) == UNLIMITED


def test_light_is_taken_from_the_budget_of_the_cycles_that_have_it() -> None:
    """What a block costs to decode, 4 ms here, is not the iterations' doing."""
    budget = learned(0.7, light_us=4000.0)
    assert budget.limits(BUDGET_US).icp_iterations == 41, "5.2 ms and 175 us each"
    assert budget.limits(BUDGET_US).points == budget.limits(BUDGET_US, light=True).points == UNLIMITED.points
    assert budget.limits(BUDGET_US, light=True).icp_iterations == 18, "8.5 ms are left"
    assert budget.limits(10_000.0, light=True).points < 1000 < budget.limits(10_000.0).points


def test_all_the_rest_of_a_cycle_is_taken_from_the_budget_too() -> None:
    budget = MeasuredBudget()
    for _ in range(20):
        budget.learn(spent(match_us(0.7), bridge=500, judge=2000, publish=1000, search=500), UNLIMITED, step())
    assert budget.limits(BUDGET_US).icp_iterations == 18


def test_what_is_left_out_is_taken_up_again_only_once_it_has_long_fitted() -> None:
    budget = learned(0.8, map_us=9000.0)
    assert budget.limits(BUDGET_US).level is DegradationLevel.NO_MAP
    levels = [budget.limits(BUDGET_US if k % 10 == 0 else 40_000.0).level for k in range(60)]
    assert set(levels) == {DegradationLevel.NO_MAP}, "one cycle in ten that does not fit"
    levels = [budget.limits(40_000.0).level for _ in range(60)]
    assert sorted(set(levels), reverse=True) == [
        DegradationLevel.NO_MAP,
        DegradationLevel.THINNED,
        DegradationLevel.FULL,
    ]
    assert levels == sorted(levels, reverse=True), "one level at a time"


def test_overruns_that_no_cost_explains_lead_down_where_that_helps() -> None:
    def after(match_us: float) -> DegradationLevel:
        budget = MeasuredBudget()
        for k in range(40):
            limits = budget.limits(BUDGET_US)
            judge_us = 20_000.0 if k % 3 == 2 else 10.0
            budget.learn(Spent({"match": match_us, "judge": judge_us}, BUDGET_US), limits, step())
        return DegradationLevel(budget.limits(BUDGET_US).level)

    assert after(9_000.0) > DegradationLevel.FULL
    assert after(100.0) is DegradationLevel.FULL, "there is nothing to be had by matching less"


def test_replay_uses_the_recorded_caps_in_order() -> None:
    first, second = Limits(3, 100, False), Limits(50, 1000, True)
    budget = RecordedBudget([first, second])
    assert [budget.limits(1.0), budget.limits(1.0)] == [first, second]
    with pytest.raises(LookupError, match="more steps than were recorded"):
        budget.limits(1.0)


def test_fixed_caps_never_change() -> None:
    budget = FixedBudget(Limits(5, 6, False))
    budget.learn(spent(1e9), UNLIMITED, step())
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
        budget.learn(spent(match_us(0.1)), UNLIMITED, step())
    budget.learn_code(20.0)
    assert budget.limits(12_500.0).codes == SEARCH_US / 20.0


def test_scans_are_dense_where_the_matcher_takes_them_for_dense() -> None:
    told = MatchSettings()
    assert (told.dense, told.coarse) == (DENSE, COARSE)


def test_down_at_once_and_up_one_rung_after_patience() -> None:
    degradation = Degradation()
    assert degradation.choose(DegradationLevel.NO_MAP) is DegradationLevel.NO_MAP
    taken = [degradation.choose(DegradationLevel.FULL) for _ in range(2 * PATIENCE)]
    assert taken == [DegradationLevel.NO_MAP] * (PATIENCE - 1) + [DegradationLevel.THINNED] * PATIENCE + [
        DegradationLevel.FULL
    ]


def test_overruns_lead_down_and_the_patience_doubles_each_time() -> None:
    degradation = Degradation()
    waited = []
    for _ in range(4):
        for _ in range(MANY):
            degradation.ended(overran=True, helps=True)
        assert degradation.level is DegradationLevel.THINNED
        count = 1
        while degradation.choose(DegradationLevel.FULL) is not DegradationLevel.FULL:
            count += 1
        waited.append(count)
    assert waited == sorted(waited)
    assert waited[0] == 2 * PATIENCE
    assert waited[-1] <= LONGEST


def test_few_overruns_and_those_that_no_rung_helps_change_nothing() -> None:
    degradation = Degradation()
    for k in range(10 * RECENT):
        degradation.ended(overran=k % 4 == 0, helps=True)
        assert degradation.level is DegradationLevel.FULL
    degradation = Degradation()
    for _ in range(100):
        degradation.ended(overran=True, helps=False)
    assert degradation.level is DegradationLevel.FULL


@given(st.lists(st.sampled_from(DegradationLevel), max_size=200))
def test_never_better_than_what_fits(fits: list[DegradationLevel]) -> None:
    degradation, before = Degradation(), DegradationLevel.FULL
    for best in fits:
        level = degradation.choose(best)
        assert level >= min(best, before)
        assert level >= before - 1
        before = level
