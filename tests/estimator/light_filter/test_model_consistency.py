"""How far lamps are bent: what is new, what has been found, what is forgotten, and what is no number."""

import math

import pytest

from estimator.light_filter.model_consistency import (
    FOUND_M,
    FOUND_MOST,
    KEPT_M,
    KEPT_S,
    START_M,
    USUAL,
    VARIES,
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


def test_lamps_as_expected_are_not_bent() -> None:
    bent = Bent()
    assert max(drive(bent, FITTING, 20.0)) == 0.0
    assert bent.now == pytest.approx(0.4)


def test_what_is_bent_is_new_until_it_has_been_found() -> None:
    told = drive(Bent(), dict.fromkeys(FITTING, 2.5), 6.0)
    assert set(told[: round(START_M / STEP_M)]) == {2.5 - USUAL}, "nothing is found before the place is"
    assert told == sorted(told, reverse=True)
    found = next(k for k, anew in enumerate(told) if anew == 0.0) * STEP_M
    assert found == pytest.approx(START_M + FOUND_M * math.log(VARIES / (VARIES - 1.0)), abs=2 * STEP_M)


def test_a_worn_lamp_that_has_been_found_is_known_when_it_comes_into_view_again() -> None:
    bent = Bent()
    first = max(drive(bent, WORN, 6.0))
    gone = max(drive(bent, FITTING, 20.0))
    again = max(drive(bent, WORN, 6.0))
    assert first > 1.5
    assert gone == 0.0
    assert again == 0.0


def test_what_is_more_than_lamps_can_be_bent_by_is_never_found() -> None:
    bent = Bent()
    assert drive(bent, dict.fromkeys(FITTING, 24.0), 50.0)[-1] == pytest.approx(24.0 - FOUND_MOST)


def test_what_a_lamp_was_bent_by_for_a_moment_is_not_found() -> None:
    bent = Bent()
    drive(bent, FITTING, 5.0)
    bent.take({**FITTING, 1: math.nan}, bent.t + STEP_S, bent.way + STEP_M)
    for _ in range(600):
        bent.take(FITTING, bent.t + 1.0, bent.way)
    assert bent.anew == 0.0
    assert drive(bent, dict.fromkeys(FITTING, 3.0), 0.1)[0] == pytest.approx(3.0 - USUAL)


def test_a_lamp_counts_for_no_more_than_one_of_which_nothing_is_known() -> None:
    far, odd = Bent(), Bent()
    far.take({**FITTING, 1: 2000.0}, 0.0, 0.0)
    odd.take({**FITTING, 1: math.nan}, 0.0, 0.0)
    assert far.now == odd.now


def test_at_another_place_nothing_has_been_found_and_what_was_of_late_stays() -> None:
    bent = Bent()
    drive(bent, WORN, 6.0)
    assert bent.anew == 0.0
    bent.elsewhere()
    assert set(drive(bent, WORN, START_M)) == {bent.now - USUAL}
    assert bent.now > 2.5


def test_it_is_known_at_this_place_only() -> None:
    bent = Bent()
    drive(bent, WORN, 6.0)
    assert max(drive(Bent(), WORN, 1.0)) > 1.5


def test_a_lamp_that_is_bent_more_than_it_was_is_news_however_long_the_others_have_been() -> None:
    bent = Bent()
    drive(bent, WORN, 20.0)
    assert max(drive(bent, {**WORN, 4: 100.0}, 1.0)) > 5.0


def test_what_lamps_were_bent_by_is_kept_for_a_while_with_other_lamps() -> None:
    bent = Bent()
    drive(bent, dict.fromkeys((5, 6), 10.0), 0.2)
    drive(bent, FITTING, KEPT_M)
    keep = math.exp(-1.0 - KEPT_M / STEP_M * STEP_S / KEPT_S)
    assert bent.now == pytest.approx(10.0 * keep, rel=0.02)


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


def test_a_start_in_the_dark_begins_with_the_first_lamp() -> None:
    bent = Bent()
    bent.take(dict.fromkeys(FITTING, 2.5), 100.0, 40.0)
    assert min(drive(bent, dict.fromkeys(FITTING, 2.5), START_M)) == 2.5 - USUAL


def test_usual_is_no_news() -> None:
    bent = Bent()
    assert max(drive(bent, dict.fromkeys(FITTING, USUAL), 1.0)) == 0.0


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
