"""Lamps are placed from a drive, told apart where codes are used again, and doubts are said."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.calibration.calibrate import TooLittle
from estimator.calibration.lamp_mapping import Heard, survey
from estimator.calibration.observations import Rows, joined
from estimator.light_filter.survey import Lamp, Survey
from tests.estimator.teach import drive, nominal, real, received

pytestmark = pytest.mark.jit


def heard(truth: Survey, seed: int, error: float = 0.02, n: int = 2500) -> Heard:
    t, pose = drive(truth, seed, n)
    rows = received(truth, t, pose, seed, error)
    codes = np.array([lamp.code for lamp in truth.lamps])
    strong = rows.amplitude > 2e-9
    coded = replace(rows, lamp=codes[rows.lamp]).chosen(strong)
    return Heard(coded, np.full(len(coded), -1, dtype=np.int64))


def test_lamps_are_found_and_the_height_too() -> None:
    truth = real(nominal(), 1)
    found = survey(heard(truth, 2), nominal().receiver, truth.depth)
    assert found.height_told
    place = {lamp.code: lamp for lamp in truth.lamps}
    assert {lamp.code for lamp in found.found.survey.lamps} == set(place)
    errors = [np.hypot(a.x - place[a.code].x, a.y - place[a.code].y) for a in found.found.survey.lamps]
    assert np.median(errors) < 0.09
    assert max(errors) < 0.2
    assert all(abs(lamp.z - 2.9) < 0.2 for lamp in found.found.survey.lamps)
    assert np.max(np.array(errors) / np.hypot(*found.sigma[:, :2].T)) < 4.5


def test_one_code_twice_makes_two_lamps() -> None:
    here = Survey((Lamp(1, 5, 1.25, 1.25, 2.9), Lamp(2, 5, 20.0, 1.25, 2.9), Lamp(3, 9, 3.75, 1.25, 2.9)))
    t = 0.1 * np.arange(3000)
    parts = []
    for x0 in (0.0, 17.0):
        pose = np.column_stack((x0 + 3 + 3 * np.sin(0.2 * t), 1.25 + 1.2 * np.sin(0.13 * t), 0.3 * t))
        parts.append(received(here, t, pose, 3))
    rows = joined(parts)
    codes = np.array([lamp.code for lamp in here.lamps])
    rows = replace(rows, lamp=codes[rows.lamp]).chosen(rows.amplitude > 4e-8)
    found = survey(Heard(rows, np.full(len(rows), -1, dtype=np.int64)), here.receiver, here.depth, 2.9)
    places = sorted((lamp.code, round(lamp.x, 1), round(lamp.y, 1)) for lamp in found.found.survey.lamps)
    assert [place[0] for place in places] == [5, 5, 9]
    assert places[0][1:] == pytest.approx((1.2, 1.2), abs=0.15)
    assert places[1][1:] == pytest.approx((20.0, 1.2), abs=0.15)


def test_what_a_lamp_said_it_is_becomes_its_number() -> None:
    truth = real(nominal(2), 4)
    h = heard(truth, 5)
    named = np.where(h.rows.lamp == 7, 4711, -1)
    found = survey(Heard(h.rows, named), truth.receiver, truth.depth, 2.9)
    assert {lamp.lamp_id for lamp in found.found.survey.lamps if lamp.code == 7} == {4711}
    assert len({lamp.lamp_id for lamp in found.found.survey.lamps}) == 4


def test_a_lamp_has_one_place_by_its_own_word() -> None:
    """Light of it that is heard far away came by way of walls; it makes no second lamp of the same number."""
    here = Survey((Lamp(1, 5, 1.25, 1.25, 2.9), Lamp(2, 5, 20.0, 1.25, 2.9, power_w=0.3), Lamp(3, 9, 3.75, 1.25, 2.9)))
    t = 0.1 * np.arange(3000)
    parts = []
    for x0 in (0.0, 17.0):
        pose = np.column_stack((x0 + 3 + 3 * np.sin(0.2 * t), 1.25 + 1.2 * np.sin(0.13 * t), 0.3 * t))
        parts.append(received(here, t, pose, 3))
    rows = joined(parts)
    codes = np.array([lamp.code for lamp in here.lamps])
    rows = replace(rows, lamp=codes[rows.lamp]).chosen(rows.amplitude > 2e-8)
    found = survey(Heard(rows, np.where(rows.lamp == 5, 77, -1)), here.receiver, here.depth, 2.9)
    lamps = found.found.survey.lamps
    assert sorted(lamp.code for lamp in lamps) == [5, 9]
    (named,) = (lamp for lamp in lamps if lamp.lamp_id == 77)
    assert (named.x, named.y) == pytest.approx((1.25, 1.25), abs=0.15)


def test_seldom_heard_codes_are_named_and_left_out() -> None:
    truth = real(nominal(2), 6)
    h = heard(truth, 7)
    few = h.rows.chosen(np.arange(5))
    rows = joined([h.rows, replace(few, lamp=np.full(5, 99))])
    found = survey(Heard(rows, np.full(len(rows), -1, dtype=np.int64)), truth.receiver, truth.depth, 2.9)
    assert found.left_out == (99,)
    with pytest.raises(TooLittle, match="drive under the lamps with the decoder on"):
        survey(Heard(few, np.full(5, -1)), truth.receiver, truth.depth, 2.9)
    with pytest.raises(ValueError, match="are not above the receiver at z"):
        survey(h, truth.receiver, truth.depth, 0.2)
    empty = Rows(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0))
    with pytest.raises(TooLittle):
        survey(Heard(empty, np.zeros(0, np.int64)), truth.receiver, truth.depth)
