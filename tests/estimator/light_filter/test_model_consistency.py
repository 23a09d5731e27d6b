"""Consistency of lamps: a deviation is new, becomes known, and fades; values that are no number."""

import math

import pytest

from estimator.light_filter.model_consistency import (
    USUAL,
    WORST,
    Bent,
)

STEP_M, STEP_S = 0.02, 0.05
FITTING = dict.fromkeys((1, 2, 3, 4), 0.4)
WORN = {**FITTING, 5: 12.0}


def drive(bent: Bent, squares: dict[int, float], metres: float) -> list[float]:
    """What is anew in each epoch of so much way."""
    told = []
    for _ in range(round(metres / STEP_M)):
        t, way = (0.0, 0.0) if math.isinf(bent.t) else (bent.t + STEP_S, bent.way + STEP_M)
        bent.take(squares, t, way)
        told.append(bent.anew)
    return told


def test_a_worn_lamp_that_has_been_found_is_known_when_it_comes_into_view_again() -> None:
    bent = Bent()
    first = max(drive(bent, WORN, 6.0))
    gone = max(drive(bent, FITTING, 20.0))
    again = max(drive(bent, WORN, 6.0))
    assert first > 1.5
    assert gone == 0.0
    assert again == 0.0


def test_what_a_lamp_was_bent_by_for_a_moment_is_not_found() -> None:
    bent = Bent()
    drive(bent, FITTING, 5.0)
    bent.take({**FITTING, 1: math.nan}, bent.t + STEP_S, bent.way + STEP_M)
    for _ in range(600):
        bent.take(FITTING, bent.t + 1.0, bent.way)
    assert bent.anew == 0.0
    assert drive(bent, dict.fromkeys(FITTING, 3.0), 0.1)[0] == pytest.approx(3.0 - USUAL)


def test_at_rest_it_fades_with_time() -> None:
    """A shadow that has passed while the robot stood on its dock is no news of the night."""
    bent = Bent()
    bent.take(dict.fromkeys(FITTING, 10.0), 0.0, 0.0)
    for k in range(1, 1201):
        bent.take(FITTING, 0.1 * k, 0.0)
    assert bent.now == pytest.approx(10.0 * math.exp(-2.0), rel=0.01)


def test_in_the_dark_nothing_fades_and_nothing_is_found() -> None:
    bent = Bent()
    bent.take(dict.fromkeys(FITTING, 10.0), 0.0, 0.0)
    bent.take(dict.fromkeys(FITTING, 1.0), 500.0, 50.0)  # nothing was received on the way
    assert bent.now > 8.0
    assert bent.found < 0.5


@pytest.mark.parametrize("odd", [math.nan, math.inf])
def test_what_is_no_number_is_as_bent_as_can_be_and_passes(odd: float) -> None:
    bent = Bent()
    drive(bent, FITTING, 5.0)
    bent.take({**FITTING, 1: odd}, bent.t + STEP_S, bent.way + STEP_M)
    assert bent.now == pytest.approx((WORST + 1.2) / 4.0)
    assert bent.anew > 20.0
    drive(bent, FITTING, 10.0)
    assert bent.now == pytest.approx(0.4, abs=0.01)
    assert math.isfinite(bent.found)
