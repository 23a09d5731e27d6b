"""The forward model against its equations written out, against finite differences, and at its edges."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.light_filter.lambertian import Wrt, expected
from estimator.light_filter.survey import Lamp, Receiver, Survey

SURVEY = Survey(receiver=Receiver(x=0.12, y=-0.05, z=0.3, order=0.8, slope_x=0.06, slope_y=-0.04), floor=0.02)
LAMP = Lamp(1, 1, 2.0, 3.0, 2.8, power_w=1.3, order=0.7, slope_x=0.05, slope_y=-0.08)


def slow(lamp: Lamp, survey: Survey, pose: np.ndarray) -> float:
    """Eq. 1 and 2 with vectors, as in a textbook."""
    rx = survey.receiver
    c, s = math.cos(pose[2]), math.sin(pose[2])
    R = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    eye = np.array((pose[0], pose[1], 0.0)) + R @ np.array((rx.x, rx.y, rx.z))
    up = R @ np.array((rx.slope_x, rx.slope_y, 1.0))
    down = np.array((lamp.slope_x, lamp.slope_y, -1.0))
    ray = np.array((lamp.x, lamp.y, lamp.z)) - eye
    d = float(np.linalg.norm(ray))
    cos_b = float(ray @ up) / d / float(np.linalg.norm(up))
    cos_a = float(-ray @ down) / d / float(np.linalg.norm(down))
    nadir = (lamp.order + 1.0) * rx.area_m2 / (2.0 * math.pi * (lamp.z - rx.z) ** 2)
    H = 0.0
    if cos_a > 0.0 and math.acos(cos_b) <= rx.half_fov_rad:
        H = (lamp.order + 1.0) * rx.area_m2 / (2.0 * math.pi * d * d) * cos_a**lamp.order * cos_b**rx.order
    return rx.responsivity * survey.depth * lamp.power_w * (H + survey.floor * nadir)


def changed(wrt: Wrt, step: float, pose: np.ndarray) -> float:
    """The textbook's ln amplitude after one quantity has been changed by ``step``."""
    lamp, survey, rx, pose = LAMP, SURVEY, SURVEY.receiver, pose.copy()
    name = wrt.name.lower()
    if wrt <= Wrt.YAW:
        pose[wrt] += step
    elif wrt is Wrt.GAIN:
        lamp = dataclasses.replace(lamp, power_w=lamp.power_w * math.exp(step))
    elif wrt is Wrt.FLOOR:
        survey = dataclasses.replace(survey, floor=survey.floor + step)
    elif name.startswith("rx_"):
        field = name[3:]
        survey = dataclasses.replace(survey, receiver=dataclasses.replace(rx, **{field: getattr(rx, field) + step}))
    else:
        field = name.removeprefix("lamp_")
        lamp = dataclasses.replace(lamp, **{field: getattr(lamp, field) + step})
    return math.log(slow(lamp, survey, pose))


poses = st.tuples(st.floats(-1.0, 5.0), st.floats(0.0, 6.0), st.floats(-3.1, 3.1)).map(np.array)


@given(pose=poses)
def test_amplitude_is_that_of_the_equations_written_out(pose: np.ndarray) -> None:
    got = expected([LAMP], SURVEY, pose)
    assert got.amplitude[0] == pytest.approx(slow(LAMP, SURVEY, pose), rel=1e-9)


@pytest.mark.parametrize("wrt", list(Wrt))
def test_every_derivative_against_finite_differences(wrt: Wrt) -> None:
    rng = np.random.default_rng(int(wrt))
    for _ in range(40):
        pose = np.array((*(np.array((LAMP.x, LAMP.y)) + rng.uniform(-2.0, 2.0, 2)), rng.uniform(-3.1, 3.1)))
        got = expected([LAMP], SURVEY, pose).jacobian[0, wrt]
        want = (changed(wrt, 1e-5, pose) - changed(wrt, -1e-5, pose)) / 2e-5
        assert got == pytest.approx(want, rel=1e-5, abs=1e-7)


def test_outside_the_field_of_view_there_is_only_the_floor() -> None:
    pose = np.array((LAMP.x + 8.0, LAMP.y, 0.0))
    got = expected([LAMP], SURVEY, pose)
    assert got.direct[0] == 0.0
    assert got.amplitude[0] == pytest.approx(slow(LAMP, SURVEY, pose))
    np.testing.assert_array_equal(got.jacobian[0, [Wrt.X, Wrt.Y, Wrt.YAW]], 0.0)
    dark = expected([LAMP], SURVEY, pose, floor=0.0)
    assert dark.amplitude[0] == 0.0
    assert np.isfinite(dark.jacobian).all()


def test_directly_below_a_level_lamp_it_is_the_link_budget_by_hand() -> None:
    """1.5 W, 70 deg, 1.2 cm2 at 2.6 m: H = 1.6461 * 1.2e-4 / (2 pi 2.6^2) = 4.65e-6; 0.4 A/W; depth 0.3."""
    lamp = Lamp(1, 1, 0.0, 0.0, 2.9)
    got = expected([lamp], Survey(receiver=Receiver(z=0.3), floor=0.0), np.zeros(3))
    assert got.amplitude[0] == pytest.approx(0.3 * 0.4 * 1.5 * 4.65e-6, rel=1e-3)
    assert got.beta_rad[0] == pytest.approx(0.0, abs=1e-7)


def test_a_lamp_surveyed_below_the_receiver_gives_finite_numbers() -> None:
    got = expected([Lamp(1, 1, 0.0, 0.0, 0.1)], SURVEY, np.zeros(3))
    assert np.isfinite(got.amplitude).all()
    assert np.isfinite(got.jacobian).all()


def test_no_lamps_no_rows() -> None:
    got = expected([], SURVEY, np.zeros(3))
    assert got.amplitude.shape == (0,)
    assert got.jacobian.shape == (0, len(Wrt))
