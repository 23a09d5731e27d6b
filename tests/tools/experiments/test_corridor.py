"""The bound along a corridor against what can be worked out by hand, and which part of a drive is a corridor."""

from __future__ import annotations

import numpy as np
import pytest

from tools.experiments import corridor
from tools.experiments.corridor_bound import Seen, Sizes, bound

NOTHING = Sizes(0.0, 0.0, 0.0, 0.0, 0.0)


def epoch(along: float, slope: float = 0.7, variance: float = 1e-4, lamp: int = 1) -> Seen:
    return Seen(along, (lamp,), np.array([variance]), np.array([slope]), np.array([0.3]))


def test_one_link_of_a_lamp_that_is_known_to_the_last_is_one_measurement() -> None:
    (sigma,) = bound([epoch(0.0)], NOTHING, start_m=0.5)
    assert sigma**-2 == pytest.approx(0.5**-2 + 0.7**2 / 1e-4)


def test_epochs_add_up_and_wheels_take_away() -> None:
    still = bound([epoch(0.0)] * 4, NOTHING)
    assert still[3] == pytest.approx(0.5 * still[0], rel=1e-3)
    moving = bound([epoch(0.0), epoch(1.0, slope=0.0)], Sizes(0.0, 0.0, 0.0, 0.0, 0.05))
    assert moving[1] ** 2 - moving[0] ** 2 == pytest.approx(0.05**2)


def test_a_gain_that_is_not_known_hides_the_place_until_the_lamp_is_passed() -> None:
    """Before the lamp and behind it the slope has another sign; gain has not."""
    sizes = Sizes(0.07, 0.0, 0.0, 0.0, 1e-4)
    before = bound([epoch(-1.0), epoch(-0.9), epoch(-0.8)], sizes)[-1]
    passed = bound([epoch(-1.0), epoch(-0.9), epoch(0.9, slope=-0.7)], sizes)[-1]
    assert before > 0.09
    assert passed < 0.015


def test_a_lamp_off_its_place_is_never_better_than_that() -> None:
    sizes = Sizes(0.0, 0.0, 0.02, 0.0, 0.0)
    assert bound([epoch(0.0, variance=1e-8)] * 50, sizes)[-1] == pytest.approx(0.02, rel=1e-2)


def test_corners_and_rooms_are_no_corridor() -> None:
    tour, _, loop = corridor.CASES
    at = np.array([(0.0, 0.0, 0.0), (-6.15, 20.0, 1.6), (-6.15, 41.0, 1.6)])
    assert corridor.axis_of(tour, at).tolist() == [corridor.NO_CORRIDOR, 1, corridor.NO_CORRIDOR]
    at = np.array([(20.0, 1.1, 0.0), (1.1, 1.1, 0.0), (38.9, 12.0, 1.6), (20.0, 23.9, 3.1)])
    assert corridor.axis_of(loop, at).tolist() == [0, corridor.NO_CORRIDOR, 1, 0]


@pytest.mark.slow
@pytest.mark.jit
def test_a_short_drive_stays_within_5_cm_along_the_corridor() -> None:
    one = corridor.trial((corridor.CASES[1], 1, 25.0))
    assert corridor.rms(one.along) < 0.05
    assert corridor.rms(one.floor) < corridor.rms(one.along)
