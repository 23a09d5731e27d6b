"""Where am I: the experiment's own parts, and a few robots switched on and carried away in the lit house."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.snapshot import State
from estimator.light_filter.light_channel import LightsSetup
from tools.experiments.relocation.maps import mapped
from tools.experiments.relocation.trial import Case, Moment, outcome, trial
from tools.experiments.relocation.worlds import Carried, Site, Stroll, lit_house, odometry, stroll
from tools.experiments.support.proof import proved_share
from tools.sim.ceiling.ceiling import Effects


def test_none_of_n_proves_three_by_n() -> None:
    assert proved_share(0, 1000) == pytest.approx(3.0 / 1000, rel=0.01)
    assert proved_share(0, 40) == pytest.approx(0.072, abs=0.001)
    assert proved_share(2, 100) == pytest.approx(0.0616, abs=0.001)


def test_places_are_free_and_codes_of_a_room_that_is_repeated_are_not_unique() -> None:
    site, twice = Site(lit_house(), Effects(), 1), Site(lit_house(reused=True), Effects(), 1)
    assert site.place.building.world.clearance(site.free).min() > 0.4
    at = np.array((2.2, 3.0))
    assert site.unique(at)
    assert not twice.unique(at)
    way = stroll(site, np.random.default_rng(1), 5.0, moving=True)
    assert len(site.codes_at(way.begin[None, :2])[0]) >= 3


def test_being_carried_is_no_motion_for_the_wheels() -> None:
    first = Stroll(np.array((1.0, 2.0, 0.5)), 0.3, 0.2)
    way = Carried(first, Stroll(np.array((9.0, 4.0, -2.0)), 0.2, 0.0), 2.0, 3.5)
    turns = list(odometry(way.rolled, (0.0, 6.0), np.random.default_rng(0)))
    in_the_air = [turn for turn in turns if 2.0 < turn.t_begin < 3.4]
    assert all(np.array_equal(turn.delta, np.zeros(3)) for turn in in_the_air)
    assert way.at(np.array([3.5]))[0] == pytest.approx((9.0, 4.0, -2.0))
    assert np.hypot(*way.at(np.array([6.0]))[0, :2] - (9.0, 4.0)) == pytest.approx(0.5)


def test_an_outcome_counts_from_when_it_was_put_down_and_says_how_long_tracking_was_wrong() -> None:
    tracking, lost = int(State.TRACKING), int(State.LOST)
    said = [(0.9, tracking, True, 0.02), (2.6, tracking, True, 3.0), (2.7, lost, False, 3.0), (2.8, lost, False, 3.0)]
    said += [(2.9, tracking, True, 0.05), (3.0, tracking, True, 0.05)]
    moments = [Moment(t, state, 0, given, off, 0.0, None) for t, state, given, off in said]
    one = outcome(Case("x", carried=True, moving=False), 1, 2.5, moments, (True, 5), 0.0)
    assert one.known_before
    assert one.right_s == pytest.approx(0.4)
    assert one.astray_s == pytest.approx(0.1)
    assert one.end == "TRACKING"


@pytest.mark.slow
def test_robots_in_the_light_are_right_within_a_second_and_never_wrong() -> None:
    site = Site(lit_house(), Effects(), 1)
    lights = LightsSetup(site.survey, clock_ppm=0.0)
    image, errors = mapped(site, lights)
    assert np.sqrt(np.mean(errors[200:, 1] ** 2)) < 0.06
    for seed in range(6):
        case = Case("lit", carried=bool(seed % 2), moving=bool(seed // 2 % 2), seconds=4.0)
        one = trial(site, image, case, seed, lights)
        assert one.right_s is not None
        assert one.right_s < 1.5
        assert one.astray_s <= 0.5
