"""Calibration finds what was put in, says how well it knows it, and says what the drive cannot tell."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.calibration.calibrate import Calibrated, TooLittle, calibrate_lamps
from estimator.calibration.observations import Rows, joined, thinned
from estimator.calibration.parameters import COMMONS, OWNS, Common, Own, Priors, linear, problem
from estimator.light_filter.lambertian import expected
from estimator.light_filter.survey import Survey
from tests.estimator.teach import drive, nominal, real, received

pytestmark = pytest.mark.jit


def taught(seed: int, error: float = 0.03, side: int = 3) -> tuple[Survey, Calibrated]:
    survey = nominal(side)
    truth = real(survey, seed)
    t, pose = drive(truth, seed + 50)
    return truth, calibrate_lamps(survey, received(truth, t, pose, seed + 90, error))


def normalised(truth: Survey, found: Calibrated) -> np.ndarray:
    """Errors in sigmas, of every parameter but the gains, whose common part is also in the orders."""
    r = truth.receiver
    values = {"floor": truth.floor, "rx_order": r.order, "rx_slope_x": r.slope_x, "rx_slope_y": r.slope_y}
    values |= {"rx_x": r.x, "rx_y": r.y}
    want: dict[tuple[int | None, str], float] = {(None, name): value for name, value in values.items()}
    for lamp in truth.lamps:
        want |= {(lamp.lamp_id, name): getattr(lamp, name) for name in ("order", "slope_x", "slope_y")}
    some = [e for e in found.estimates if (e.lamp_id, e.name) in want]
    assert len(some) == 6 + 3 * len(truth.lamps)
    return np.array([(e.after - want[e.lamp_id, e.name]) / e.sigma for e in some])


def test_what_was_put_in_is_found_and_the_sigmas_are_honest() -> None:
    truth, found = taught(1)
    before, after = found.rms()
    assert before > 0.1
    assert after < 0.04
    z = normalised(truth, found)
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.8
    assert np.abs(z).max() < 4.5
    sigma = np.array([lamp.sigma_ln for lamp in found.survey.lamps])
    error = np.log([a.power_w / b.power_w for a, b in zip(found.survey.lamps, truth.lamps, strict=True)])
    assert np.abs(error / sigma).max() < 4.0
    assert sigma.max() < 0.09
    assert found.converged
    assert not found.untouched


@pytest.mark.slow
def test_sigmas_are_honest_over_many_drives() -> None:
    z = np.concatenate([normalised(*taught(seed)) for seed in range(10)])
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    assert np.mean(np.abs(z) > 3.0) < 0.03


def test_without_errors_it_is_exact() -> None:
    truth, found = taught(2, error=0.0)
    lamps = list(zip(found.survey.lamps, truth.lamps, strict=True))
    assert max(abs(a.order - b.order) for a, b in lamps) < 0.12  # told only as order of lamp plus order of receiver
    assert max(abs(a.order + found.survey.receiver.order - b.order - 1.1) for a, b in lamps) < 0.05
    assert abs(found.survey.floor - truth.floor) < 0.002
    assert found.scale < 0.01


def test_blocked_light_and_mirrors_are_left_out() -> None:
    survey = nominal()
    truth = real(survey, 3)
    t, pose = drive(truth, 4)
    rows = received(truth, t, pose, 5, 0.02)
    blocked = (np.sin(0.5 * rows.t) > 0.8) & (rows.lamp % 3 == 0)
    bright = (np.sin(0.3 * rows.t) > 0.97) & (rows.lamp == 4)
    amplitude = rows.amplitude * np.where(blocked, 0.2, 1.0) * np.where(bright, 1.8, 1.0)
    found = calibrate_lamps(survey, replace(rows, amplitude=amplitude))
    clean = calibrate_lamps(survey, rows)
    for a, b in zip(found.survey.lamps, clean.survey.lamps, strict=True):
        assert abs(np.log(a.power_w / b.power_w)) < 0.02
    assert found.used.sum() < clean.used.sum()


def test_one_line_does_not_tell_everything() -> None:
    """Straight ahead under one row of lamps: slopes across the way are not told, nor lamps two rows away."""
    survey = nominal()
    truth = real(survey, 6)
    x = np.linspace(0.3, 7.2, 600)
    pose = np.column_stack((x, np.full(600, 1.25), np.zeros(600)))
    found = calibrate_lamps(survey, received(truth, x, pose, 7, 0.02))
    told = {(e.lamp_id, e.name): e.told for e in found.estimates}
    after = {(e.lamp_id, e.name): e.after for e in found.estimates}
    assert told[None, "rx_x"]  # where a lamp is brightest
    assert not told[None, "rx_y"]
    assert not told[1, "slope_y"]
    assert abs(after[1, "slope_y"]) < 0.05
    assert not told[9, "order"]  # two rows away
    assert set(found.untouched) <= {7, 8, 9}


def test_where_the_drive_began_is_found() -> None:
    survey = nominal()
    truth = real(survey, 8)
    t, pose = drive(truth, 9)
    rows = received(truth, t, pose, 10, 0.02)
    c, s = np.cos(-0.1), np.sin(-0.1)
    x, y = pose[:, 0] - 0.3, pose[:, 1] + 0.2
    there = np.column_stack((c * x - s * y, s * x + c * y, pose[:, 2] - 0.1))
    moved = replace(rows, pose=np.tile(there, (len(survey.lamps), 1)))
    found = calibrate_lamps(survey, moved, Priors(frame=0.5, frame_yaw=0.3))
    assert found.T_survey_drive == pytest.approx([0.3, -0.2, 0.1], abs=0.03)
    sigma = {e.name: e.sigma for e in found.estimates if e.lamp_id is None}
    assert sigma["frame_x"] < 0.03
    assert sigma["frame_yaw"] < 0.02


def test_derivatives_agree_with_differences() -> None:
    survey = real(nominal(2), 11)
    task = problem(survey, Priors())
    theta = task.before.copy()
    theta[[Common.FRAME_X, Common.FRAME_Y, Common.FRAME_YAW, Common.HEIGHT]] = 0.2, -0.1, 0.15, 0.05
    t, pose = drive(survey, 12, 12)
    rows = received(survey, t, pose, 13)
    here = linear(task, rows, theta)
    seen = here.seen
    assert seen.sum() > 10
    for k in range(COMMONS + OWNS):
        step = 1e-6
        high, low = theta.copy(), theta.copy()
        high[k], low[k] = theta[k] + step, theta[k] - step
        slope = -(linear(task, rows, high).residual - linear(task, rows, low).residual) / (2.0 * step)
        mine = here.common[:, k] if k < COMMONS else here.own[:, k - COMMONS] * (rows.lamp == 0)
        assert mine[seen] == pytest.approx(slope[seen], abs=2e-5), (k, Own(k - COMMONS) if k >= COMMONS else Common(k))


def test_rows_are_what_optics_expects() -> None:
    survey = nominal(2)
    t, pose = drive(survey, 1, 5)
    rows = received(survey, t, pose, 1)
    for i in range(len(rows)):
        want = expected(survey.lamps, survey, rows.pose[i]).amplitude[rows.lamp[i]]
        assert rows.amplitude[i] == pytest.approx(want, rel=0.02)


def test_standing_still_counts_once() -> None:
    survey = nominal(2)
    t, pose = drive(survey, 1, 300)
    rows = received(survey, t, pose, 1)
    still = received(survey, np.arange(5000.0), np.tile(pose[7], (5000, 1)), 2)
    assert len(thinned(joined([rows, still]))) == len(thinned(rows))


def test_too_little_is_said() -> None:
    survey = nominal(2)
    t, pose = drive(survey, 1, 4)
    with pytest.raises(TooLittle, match="at least 30"):
        calibrate_lamps(survey, received(survey, t, pose, 1))


@pytest.mark.parametrize("column", ["pose", "amplitude", "sigma"])
def test_what_is_not_a_number_is_refused(column: str) -> None:
    survey = nominal(2)
    t, pose = drive(survey, 1, 4)
    rows = received(survey, t, pose, 1)
    broken = getattr(rows, column).copy()
    broken.flat[3] = np.nan
    with pytest.raises(ValueError, match="finite"):
        replace(rows, **{column: broken})
    with pytest.raises(ValueError, match="unequal length"):
        Rows(rows.pose, rows.lamp[1:], rows.amplitude, rows.sigma, rows.t)
