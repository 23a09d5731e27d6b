"""Relocation: the judge of an outcome, and a few robots in the lit house."""

import numpy as np
import pytest

from daemon.snapshot import State
from estimator.light_filter.light_channel import LightsSetup
from tools.experiments.relocation.maps import mapped
from tools.experiments.relocation.trial import Case, Moment, outcome, trial
from tools.experiments.relocation.worlds import Site, lit_house
from tools.sim.ceiling.ceiling import Effects


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
