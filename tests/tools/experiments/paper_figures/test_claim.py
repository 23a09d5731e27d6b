"""The claim's pairs are what they say, and a match's effort is told again as it was."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.numerics import se2
from estimator.scan_matching.distance_axis import build_axis
from tools.experiments.paper_figures import claim
from tools.experiments.paper_figures.claim_cost import effort_of, look_up, timed
from tools.experiments.paper_figures.claim_cycle import burden
from tools.experiments.paper_figures.claim_pairs import (
    BACK_M,
    GOOD,
    LIT,
    NEAR_M,
    NONE,
    SLIPPING,
    WHEELS,
    Condition,
    Pair,
    apart,
    drive_of,
    pairs_of,
    returns,
    way_of,
)
from tools.experiments.support.report import Work

ROOM = Condition("room", "room", 0.5, GOOD)


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    run, laser = drive_of(ROOM, 1, 14.0)
    return pairs_of(run, laser, way_of(run), apart(run, laser, 0.5, 4))


def test_ideas_of_the_motion_are_as_good_as_their_sensors(pairs: list[Pair]) -> None:
    for pair in pairs:
        assert pair.new.t_end - pair.reference.t_end == pytest.approx(0.5, abs=0.02)
        off = {idea: float(np.hypot(*se2.between(pair.truth, T)[:2])) for idea, T in pair.ideas.items()}
        assert np.all(pair.ideas[NONE] == 0.0)
        assert off[NONE] == pytest.approx(float(np.hypot(*pair.truth[:2])))
        assert off[WHEELS] < 0.01
        assert off[LIT] < 0.15


def test_returns_are_near_earlier_places_after_a_long_way() -> None:
    run, laser = drive_of(ROOM, 1)
    found = returns(run, laser, 10)
    assert len(found) == 10
    for old, new in found:
        t = laser.model.true_period_s * np.array((old, new))
        a, b = run.truth(t)
        assert np.hypot(*(a - b)[:2]) < NEAR_M
        assert np.ptp(run.drive.travelled(t)) > BACK_M
        assert abs(se2.wrap(a[2] - b[2])) < 0.45


def test_slip_makes_the_wheels_worse_and_nothing_else() -> None:
    (good, _), (bad, _) = (drive_of(Condition("", "room", 0.5, wheels), 2, 40.0) for wheels in (GOOD, SLIPPING))
    ends = [run.dead_reckoning()[-1] - run.truth(np.array([40.0]))[0] for run in (good, bad)]
    assert np.hypot(*ends[1][:2]) > 2.0 * np.hypot(*ends[0][:2])
    np.testing.assert_array_equal(good.truth(np.arange(5.0)), bad.truth(np.arange(5.0)))


@pytest.mark.parametrize("matcher", sorted(claim.MATCHERS))
def test_effort_is_what_the_match_took_and_a_worse_idea_takes_more(matcher: str, pairs: list[Pair]) -> None:
    found = claim.outcomes(pairs, claim.MATCHERS[matcher])
    assert all(one.close for one in found[LIT])
    for one in found[LIT]:
        assert one.effort.iterations >= 2
        assert one.effort.visits >= one.effort.sought > 0
        assert one.ms > 0.0
    visits = {idea: sum(one.effort.visits for one in some) for idea, some in found.items()}
    assert visits[WHEELS] < visits[NONE]
    again = claim.outcomes(pairs[:1], claim.MATCHERS[matcher])[NONE][0]
    assert again.effort == claim.outcomes(pairs[:1], claim.MATCHERS[matcher])[NONE][0].effort


def test_look_ups_told_again_are_those_of_the_trace(pairs: list[Pair]) -> None:
    """All, where partners are not kept; on one axis a query visits what is as far from the centre, within its pair."""
    rng = np.random.default_rng(3)
    points, queries = rng.uniform(-5.0, 5.0, (300, 2)), rng.uniform(-5.0, 5.0, (40, 2))
    axis = build_axis(points, np.zeros(2), sectors=1)
    visits, _ = look_up((axis.rows, axis.start, axis.rays), queries, 20.0)
    r, rq = np.hypot(*points.T), np.hypot(*queries.T)
    best = np.min(np.hypot(*(points[:, None] - queries).T), axis=1)
    least = int(sum(np.count_nonzero(np.abs(r - a) < d) for a, d in zip(rq, best, strict=True)))
    assert 0.9 * least <= visits <= least + 2 * len(queries)
    trace = np.zeros((2, 13))
    trace[:, [4, 5, 12]] = (20.0, 1.0, 40.0)
    both = effort_of(queries, (axis.rows, axis.start, axis.rays), trace, keeps=False)
    assert (both.iterations, both.sought, both.visits) == (2, 80, 2 * visits)
    kept = effort_of(queries, (axis.rows, axis.start, axis.rays), trace, keeps=True)
    assert kept.visits == visits  # nothing has moved: nobody is looked up again


def test_works_are_timed_in_turn() -> None:
    order: list[int] = []
    times = timed([lambda: order.append(0), lambda: order.append(1)], 2)
    assert order == [0, 1, 0, 1]
    assert all(0.0 <= t < 100.0 for t in times)


@pytest.mark.slow
def test_three_estimators_ride_the_same_cycles() -> None:
    rows = burden(1.0, 1)
    assert [row[0] for row in rows] == ["laser alone", "with light, decoded", "with light, decoding included"]
    assert rows[0][-1] == 0.0


@pytest.mark.slow
def test_a_small_part_of_all_of_it() -> None:
    report = claim.run(True, Work())
    assert [len(table.rows) for table in report.tables] == [6, 6, 3]
