"""Down at once, up slowly, one rung at a time; and what has come down again and again stays down longer."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from daemon.runtime.degradation import LONGEST, MANY, PATIENCE, RECENT, Ladder
from estimator.measurements import Rung


def test_down_at_once_and_up_one_rung_after_patience() -> None:
    ladder = Ladder()
    assert ladder.take(Rung.NO_MAP) is Rung.NO_MAP
    taken = [ladder.take(Rung.FULL) for _ in range(2 * PATIENCE)]
    assert taken == [Rung.NO_MAP] * (PATIENCE - 1) + [Rung.THINNED] * PATIENCE + [Rung.FULL]


def test_overruns_lead_down_and_the_patience_doubles_each_time() -> None:
    ladder = Ladder()
    waited = []
    for _ in range(4):
        for _ in range(MANY):
            ladder.ended(overran=True, helps=True)
        assert ladder.rung is Rung.THINNED
        count = 1
        while ladder.take(Rung.FULL) is not Rung.FULL:
            count += 1
        waited.append(count)
    assert waited == sorted(waited)
    assert waited[0] == 2 * PATIENCE
    assert waited[-1] <= LONGEST


def test_few_overruns_and_those_that_no_rung_helps_change_nothing() -> None:
    ladder = Ladder()
    for k in range(10 * RECENT):
        ladder.ended(overran=k % 4 == 0, helps=True)
        assert ladder.rung is Rung.FULL
    ladder = Ladder()
    for _ in range(100):
        ladder.ended(overran=True, helps=False)
    assert ladder.rung is Rung.FULL


@given(st.lists(st.sampled_from(Rung), max_size=200))
def test_never_better_than_what_fits(fits: list[Rung]) -> None:
    ladder, before = Ladder(), Rung.FULL
    for best in fits:
        rung = ladder.take(best)
        assert rung >= min(best, before)
        assert rung >= before - 1
        before = rung
