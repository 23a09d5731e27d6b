"""Down at once, up slowly, one level at a time; and what has come down again and again stays down longer."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from daemon.runtime.degradation import LONGEST, MANY, PATIENCE, RECENT, Degradation
from estimator.measurements import DegradationLevel


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
