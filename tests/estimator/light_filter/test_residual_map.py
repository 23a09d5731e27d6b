"""The residual map learns what stays where it is, knows where it knows nothing, and is cheap to look up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.calibration.gaussian_process import Hyper, choose, fit, matern
from estimator.calibration.observations import Rows, thinned
from estimator.calibration.residual_map_fit import learn, residuals_of
from estimator.light_filter.residual_lookup import expected_ln, look_up
from estimator.light_filter.residual_map import ResidualMap
from estimator.light_filter.survey import Survey
from tests.estimator.teach import drive, nominal, received

pytestmark = pytest.mark.jit


HYPER = Hyper(0.1, 1.0, 0.006)


@pytest.fixture(scope="module")
def lesson() -> tuple[Survey, Rows, Rows]:
    """A survey that is right up to ripples, a drive to learn from and one to be tested on."""
    survey = nominal(2)
    t, pose = drive(survey, 3, 4000)
    rows = received(survey, t, pose, 4, 0.06)
    return survey, thinned(rows.chosen(rows.t < 300.0)), rows.chosen(rows.t > 300.0)


@pytest.fixture(scope="module")
def learned(lesson: tuple[Survey, Rows, Rows]) -> ResidualMap:
    return learn(lesson[0], lesson[1], HYPER, cell=0.4)


def left_over(residuals: ResidualMap, survey: Survey, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Residuals without the map, and with it."""
    parts = residuals_of(survey, rows)
    flat = [(v, [expected_ln(residuals, k, *p)[0] for p in places]) for k, (places, v, _) in enumerate(parts)]
    before = np.concatenate([v for v, _ in flat])
    return before, before - np.concatenate([m for _, m in flat])


@pytest.mark.slow
def test_it_takes_away_what_stays_where_it_is(lesson: tuple[Survey, Rows, Rows]) -> None:
    survey, teach, test = lesson
    before, after = left_over(learn(survey, teach), survey, test)
    assert before.std() > 0.05
    assert after.std() < 0.6 * before.std()


def test_passers_by_are_not_learned(lesson: tuple[Survey, Rows, Rows], learned: ResidualMap) -> None:
    survey, teach, test = lesson
    blocked = np.random.default_rng(1).random(len(teach)) < 0.05
    spoiled = replace(teach, amplitude=teach.amplitude * np.where(blocked, 0.2, 1.0))
    before, clean = left_over(learned, survey, test)
    _, after = left_over(learn(survey, spoiled, HYPER, cell=0.4), survey, test)
    assert clean.std() < 0.6 * before.std()
    assert after.std() < 0.7 * before.std()


def test_off_the_way_it_knows_nothing(lesson: tuple[Survey, Rows, Rows], learned: ResidualMap) -> None:
    teach, residuals = lesson[1], learned
    mean, sigma, gradient = expected_ln(residuals, 0, 200.0, -70.0)
    assert (mean, sigma) == (0.0, residuals.grid[0, 3])
    assert not gradient.any()
    inside = expected_ln(residuals, 0, *teach.pose[0, :2])[1]
    assert inside < 0.5 * residuals.grid[0, 3]


def test_the_kernel_and_its_gradient_agree_with_the_grid(learned: ResidualMap) -> None:
    r = learned
    g, out, twin = np.random.default_rng(2), np.zeros(4), np.zeros(4)
    for _ in range(200):
        k = int(g.integers(len(r.lamp_ids)))
        x, y = r.grid[k, :2] + g.uniform(-0.5, r.grid[k, 2] * r.mean.shape[1] + 0.5, 2)
        look_up(r.mean[k], r.sigma[k], r.grid[k], x, y, out)
        look_up.py_func(r.mean[k], r.sigma[k], r.grid[k], x, y, twin)  # type: ignore[attr-defined]  # of a kernel
        assert out == pytest.approx(twin)
        step = 1e-7
        ahead = [expected_ln(r, k, x + step * a, y + step * b)[0] for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        slope = np.array((ahead[0] - ahead[1], ahead[2] - ahead[3])) / (2.0 * step)
        inside = all(
            np.abs((v - o) / r.grid[k, 2] % 1.0 - 0.5) < 0.499 for v, o in zip((x, y), r.grid[k, :2], strict=True)
        )
        if inside:
            assert out[2:] == pytest.approx(slope, abs=1e-6)
    i, j = 5, 9
    node = r.grid[1, :2] + r.grid[1, 2] * np.array((j, i)) + 1e-12
    assert expected_ln(r, 1, *node)[0] == pytest.approx(r.mean[1, i, j], abs=1e-9)


def test_left_out_values_choose_length_and_noise() -> None:
    g = np.random.default_rng(5)
    places = g.uniform(0.0, 6.0, (60, 2))
    K = matern(Hyper(0.1, 1.5, 0.0), places, places)
    values = np.linalg.cholesky(K + 1e-9 * np.eye(60)) @ g.normal(size=60) + 0.025 * g.normal(size=60)
    values[::17] -= 1.5  # shadows
    found = choose([(places, values, np.zeros(60))])
    # a small room tells the roughness, not amplitude and length apart (H. Zhang, JASA 99, 2004)
    roughness = found.amplitude**2 / found.length**3
    assert 0.25 < roughness / (0.1**2 / 1.5**3) < 4.0
    assert 0.01 < found.noise < 0.06


def test_the_process_agrees_with_its_textbook_form() -> None:
    g = np.random.default_rng(6)
    places, values = g.uniform(0, 3, (9, 2)), g.normal(0.0, 0.001, 9)
    hyper = Hyper(0.1, 1.0, 5.0)  # so much noise that no value is an outlier
    mean, sigma = fit(hyper, places, values).at(places[:2] + 0.1)
    K = matern(hyper, places, places) + 25.0 * np.eye(9)
    k = matern(hyper, places[:2] + 0.1, places)
    assert mean == pytest.approx(k @ np.linalg.solve(K, values))
    assert sigma**2 == pytest.approx(0.01 - np.diag(k @ np.linalg.solve(K, k.T)))


def test_nothing_to_learn_from_is_said(lesson: tuple[Survey, Rows, Rows]) -> None:
    survey, teach, _ = lesson
    with pytest.raises(ValueError, match="from 8 positions"):
        learn(survey, teach.chosen(np.arange(4)))
