"""How far lamps are bent, as the `lights` filter tells it: at starts, over way, from run to run."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.light_filter import light_filter as lf
from estimator.light_filter.gain_memory import gains_known, recall
from estimator.light_filter.link_gating import forget
from estimator.result import Fix
from tests.estimator.light_filter.test_light_filter import follow
from tests.estimator.light_room import LAMPS, SURVEY, Room, circle, wheels

pytestmark = pytest.mark.jit


def uneven(even: float, odd: float) -> Room:
    """A room in which every second lamp has so many times the power that the survey says, and the others so many."""
    return Room(lamps=[replace(lamp, power_w=(even, odd)[lamp.lamp_id % 2] * lamp.power_w) for lamp in LAMPS])


def test_lamps_that_have_to_be_bent_for_their_light_to_fit_are_told() -> None:
    """Every second one is half as bright again as the survey says, as if a wall brought its light too."""
    usual, bent = (follow(lf.new_lights(SURVEY), room, 6.0) for room in (Room(), uneven(1.0, 1.5)))
    assert max(result.bent for result in usual[20:]) == 0.0
    assert max(result.bent for result in bent[20:]) > 1.0


def test_lamps_that_stay_bent_have_been_found() -> None:
    filter_ = lf.new_lights(SURVEY)
    told = follow(filter_, uneven(1.0, 1.25), 40.0)
    assert max(result.bent for result in told[20:]) > 1.0
    assert filter_.bent.now > 1.5
    assert told[-1].bent < 0.5


def test_lamps_of_which_the_survey_is_far_off_are_bent_for_the_whole_of_a_run() -> None:
    """A wrong place has found lamps that fit it alone, and keeps them for as long as the robot stays there."""
    assert follow(lf.new_lights(SURVEY), uneven(1.0, 1.5), 40.0)[-1].bent > 1.5


def test_a_lamp_that_goes_out_slowly_is_bent_however_long_the_place_has_been_known() -> None:
    """It leads the place astray meanwhile: a link is paused when it differs at once, not little by little."""
    few = tuple(lamp for lamp in LAMPS if lamp.lamp_id in (6, 7, 10, 11))
    filter_ = lf.new_lights(replace(SURVEY, lamps=few))
    dimming = Room(lamps=few, cover=lambda lamp, t: math.exp(-0.7 * max(t - 30.0, 0.0)) if lamp == 7 else 1.0)
    told = follow(filter_, dimming, 36.0)
    assert max(result.bent for result in told[200:295]) < 0.1
    assert max(result.bent for result in told[300:]) > 0.5


def test_where_the_place_is_in_doubt_nothing_has_been_found() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, uneven(1.0, 1.25), 40.0)
    assert filter_.bent.found > 2.0
    filter_.t_odd = -math.inf
    assert lf.fix_of(filter_, np.eye(3)) is Fix.LOST
    assert filter_.bent.anew > 1.0
    assert follow(filter_, uneven(1.0, 1.25), 1.0, start=40.0)[-1].bent > 0.5


def test_healthy_lamps_are_not_bent_from_the_first_epoch_on() -> None:
    told = follow(lf.new_lights(SURVEY), Room(), 10.0)
    assert max(result.bent for result in told) == 0.0


def test_what_lamps_were_bent_by_under_another_hypothesis_has_not_been_found() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 0.2)
    first, second = filter_.tracks[:2]
    filter_.bent.now, filter_.bent.found, filter_.bent.begun = 9.0, 8.0, -10.0
    second.weight = first.weight + 50.0
    follow(filter_, Room(), 0.1, start=0.2)
    assert filter_.tracks[0] is not first
    assert filter_.bent.found < 1.0
    assert filter_.bent.begun > 0.0
    assert filter_.bent.now > 5.0


def test_a_lamp_that_described_itself_is_forgotten_with_all_that_was_known_of_it() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 1.0)
    own = replace(LAMPS[0], lamp_id=99, code=40)
    recall(filter_, {99: (np.full(3, 0.4), np.full(3, 1e-4))}, None, (own,))
    filter_.catalogue.heard[99] = -1e9
    filter_.bent.take({99: 2.0}, 0.0, 0.0)
    forget(filter_)
    assert 99 not in filter_.catalogue.by_id
    assert not filter_.recalled
    assert filter_.bent.lamps.keys() < {lamp.lamp_id for lamp in LAMPS}
    assert 99 not in filter_.gains


def test_lamps_that_are_covered_for_a_moment_are_as_bent_as_they_were() -> None:
    filter_ = lf.new_lights(SURVEY)
    room = uneven(1.0, 1.5)
    before = follow(filter_, room, 5.0)[-1]
    room.cover = lambda _lamp, _t: 0.0
    dark = follow(filter_, room, 0.3, start=5.0)
    assert before.bent > 0.5
    assert {result.bent for result in dark} == {before.bent}
    assert not dark[-1].accepted


def test_how_far_lamps_were_bent_is_forgotten_over_way() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, Room(), 6.0)
    filter_.bent.now = 10.0
    told = []
    for _ in range(20):
        follow(filter_, Room(), 0.1, start=6.0 + 0.1 * len(told))
        told.append(filter_.bent.now)
    assert 9.0 < told[0] < 10.0
    assert told[17] == pytest.approx(10.0 * math.exp(-0.72 / 0.7 - 1.8 / 60.0), rel=0.03)


def test_a_gain_that_another_run_has_learned_is_not_bent() -> None:
    """Worn lamps are what is expected then, however far they are from the survey."""
    first = lf.new_lights(SURVEY)
    before = follow(first, uneven(1.0, 0.7), 15.0)
    again = lf.new_lights(SURVEY)
    recall(again, gains_known(first), None, ())
    after = follow(again, uneven(1.0, 0.7), 6.0)
    assert max(result.bent for result in before[20:]) > 0.3
    assert max(result.bent for result in after[20:]) == 0.0
    assert again.bent.now < 0.5


def test_what_a_place_has_made_of_lamps_is_not_expected_where_the_next_is_looked_for() -> None:
    filter_ = lf.new_lights(SURVEY)
    follow(filter_, uneven(1.0, 1.5), 6.0)
    lf.place(filter_, circle(6.0), np.diag((0.1, 0.1, 0.05)) ** 2)
    assert lf.result(filter_).bent == 0.0
    assert max(result.bent for result in follow(filter_, uneven(1.0, 1.5), 0.3, start=6.0)) > 1.0


def test_what_is_said_between_two_epochs_is_as_bent_as_the_latest() -> None:
    filter_ = lf.new_lights(SURVEY)
    told = follow(filter_, uneven(0.7, 1.3), 5.0)[-1]
    lf.predict(filter_, wheels(circle, 5.05, 0.05))
    assert lf.result(filter_).bent == told.bent > 0.0
    lf.reset(filter_)
    assert lf.result(filter_).bent == 0.0
