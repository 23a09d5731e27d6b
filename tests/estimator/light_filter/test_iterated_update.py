"""Links taken in where the equations bend: the fit never gets worse than the prediction's, and ends near its best."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from estimator.light_filter import measurement_update, state_vector
from estimator.light_filter.iterated_update import Seen, nis_bound, take_in
from estimator.measurements import Array
from estimator.numerics import se2
from tests.estimator.light_filter.test_state_vector import N, lamp_table, links_of, view

ROW = [5, 9]
"""Two lamps of one row."""


def beside_a_row(seed: int) -> tuple[Array, Array, Array]:
    """Prediction, its covariance, links: near the line through two lamps, the place across it hardly known.

    Walls make the lamps seem stronger or weaker by a tenth, three times as much as the filter takes them to.
    """
    rng = np.random.default_rng(seed)
    lamps = lamp_table()[ROW, :2]
    along = (lamps[1] - lamps[0]) / np.linalg.norm(lamps[1] - lamps[0])
    across = np.array((-along[1], along[0]))
    truth = np.zeros(state_vector.SIZE)
    truth[:2] = lamps[0] + rng.uniform(0.1, 0.9) * (lamps[1] - lamps[0]) + rng.normal(0, 0.3) * across
    truth[state_vector.YAW], truth[state_vector.FLOOR] = rng.uniform(-3, 3), np.log(0.015)
    P = np.zeros((state_vector.SIZE, state_vector.SIZE))
    P[:2, :2] = 0.07**2 * np.outer(along, along) + 0.5**2 * np.outer(across, across)
    P[2, 2] = 0.12**2
    P[range(3, N), range(3, N)] = 0.02**2
    P[
        range(state_vector.FIRST + state_vector.ERROR, N, state_vector.OWN),
        range(state_vector.FIRST + state_vector.ERROR, N, state_vector.OWN),
    ] = 0.1
    x = truth.copy()
    x[:3] += np.linalg.cholesky(P[:3, :3]) @ rng.standard_normal(3)
    links = links_of(truth, ROW, seed)
    links[:, measurement_update.LN] += 0.1 * rng.standard_normal(len(ROW))
    return x, P, links


def seen_from(x: Array, P: Array, links: Array) -> Array:
    out = np.zeros((len(links), measurement_update.OUT_COLUMNS))
    measurement_update.linearise(x, P, links, lamp_table(), view(), out)
    return out


def deviations(x: Array, x0: Array, P: Array, links: Array) -> Array:
    """Of a state from the prediction and from the links, each over its standard deviation."""
    off = (x - x0)[:N]
    off[state_vector.YAW] = se2.wrap(float(off[state_vector.YAW]))
    out = seen_from(x, P, links)
    apart = np.linalg.solve(np.linalg.cholesky(P[:N, :N]), off)
    return np.concatenate((apart, out[:, measurement_update.RESIDUAL] / np.sqrt(out[:, measurement_update.WHITE])))


def cost(*what: Array) -> float:
    return float(np.sum(deviations(*what) ** 2))


def undamped(x0: Array, P0: Array, links: Array) -> Array:
    """Full steps, as often as the method may take them."""
    x = x0.copy()
    for _ in range(8):
        around, P = x.copy(), P0.copy()
        x = x0.copy()
        measurement_update.absorb(x, P, N, around, links, seen_from(around, P0, links))
    return x


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.jit) for seed in range(1, 20))])
def test_the_outcome_fits_as_well_as_anything_near(seed: int) -> None:
    x0, P0, links = beside_a_row(seed)
    x, P = x0.copy(), P0.copy()
    take_in(x, P, N, Seen(links, lamp_table(), view()), seen_from(x, P, links), bounded=False)
    begun, ended = cost(x0, x0, P0, links), cost(x, x0, P0, links)
    assert ended <= begun

    def of_some(z: Array) -> Array:
        y = x.copy()
        y[:N] = z
        return deviations(y, x0, P0, links)

    best = 2.0 * float(least_squares(of_some, x[:N], x_scale=np.sqrt(np.diag(P0)[:N])).cost)
    assert ended - best <= 0.1 * (begun - best) + 0.5
    assert np.linalg.eigvalsh(P[:N, :N]).min() > 0.0
    assert P[0, 0] + P[1, 1] <= P0[0, 0] + P0[1, 1]


def test_full_steps_would_often_end_where_nothing_fits() -> None:
    """Else the test above would test nothing."""
    worse = 0
    for seed in range(20):
        x0, P0, links = beside_a_row(seed)
        x, P = x0.copy(), P0.copy()
        take_in(x, P, N, Seen(links, lamp_table(), view()), seen_from(x, P, links), bounded=False)
        worse += cost(undamped(x0, P0, links), x0, P0, links) > 4.0 + cost(x, x0, P0, links)
    assert worse >= 3


def test_where_the_equations_are_straight_it_is_one_update() -> None:
    x0, P0, links = beside_a_row(1)
    P0[:N, :N] *= 1e-4
    P0[
        range(state_vector.FIRST + state_vector.ERROR, N, state_vector.OWN),
        range(state_vector.FIRST + state_vector.ERROR, N, state_vector.OWN),
    ] = 1.0
    x, P = x0.copy(), P0.copy()
    told = take_in(x, P, N, Seen(links, lamp_table(), view()), seen_from(x, P, links), bounded=False)
    once, P_once = x0.copy(), P0.copy()
    assert told == measurement_update.absorb(once, P_once, N, x0.copy(), links, seen_from(x0, P0, links))[0]
    np.testing.assert_array_equal(x, once)
    np.testing.assert_array_equal(P, P_once)


def test_links_that_are_all_left_out_change_nothing() -> None:
    x0, P0, links = beside_a_row(2)
    out = seen_from(x0, P0, links)
    out[:, measurement_update.WHITE] = np.inf
    x, P = x0.copy(), P0.copy()
    assert take_in(x, P, N, Seen(links, lamp_table(), view()), out, bounded=True) == 0.0
    np.testing.assert_array_equal(x, x0)
    np.testing.assert_array_equal(P, P0)


def moved_apart(by: float) -> tuple[Array, Array, Array]:
    """Two lamps of a row, one ahead and one behind, a gain of both that is hardly known; light has changed by a share.

    Either lamp for itself is as strong as it may be; together they ask for a place along the row that is known not to
    be, or for anything that goes with it.
    """
    x, P, links = beside_a_row(3)
    lamps = lamp_table()[ROW, :2]
    x[:2] = lamps.mean(axis=0) + np.array((0.1, 0.05))
    links = links_of(x, ROW, 3)
    links[:, measurement_update.LN] += by * np.array((1.0, -1.0))
    P[state_vector.COMMON, state_vector.COMMON] = 0.4**2
    P[
        range(state_vector.FIRST + state_vector.ERROR, N, state_vector.OWN),
        range(state_vector.FIRST + state_vector.ERROR, N, state_vector.OWN),
    ] = 1e-3
    return x, P, links


def squared(x: Array, x0: Array, P: Array) -> float:
    """Mahalanobis distance of a state from the prediction, squared."""
    return float(np.sum(deviations(x, x0, P, np.zeros((0, measurement_update.LINK_COLUMNS))) ** 2))


@pytest.mark.parametrize("by", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("third", [False, True], ids=["alone", "beside one that is left out"])
def test_links_that_no_state_explains_lead_it_no_farther_than_it_may_be(by: float, third: bool) -> None:
    x0, P0, links = moved_apart(by)
    if third:
        links = np.vstack((links, links_of(x0, [6], 1)))
    ended, noise = {}, seen_from(x0, P0, links)[:2, measurement_update.WHITE]
    for bounded in (False, True):
        x, P, out = x0.copy(), P0.copy(), seen_from(x0, P0, links)
        out[2:, measurement_update.WHITE] = np.inf
        take_in(x, P, N, Seen(links, lamp_table(), view()), out, bounded=bounded)
        left = seen_from(x, P0, links)[:2, measurement_update.RESIDUAL] ** 2 / out[:2, measurement_update.WHITE]
        ended[bounded] = squared(x, x0, P0) + float(np.sum(left))
        factor = out[:2, measurement_update.WHITE] / noise
        assert factor[0] == pytest.approx(factor[1])
        assert (factor[0] > 1.0) == bounded
        assert np.isinf(out[2:, measurement_update.WHITE]).all()
        assert np.linalg.eigvalsh(P[:N, :N]).min() > 0.0
        assert np.trace(P[:2, :2]) < np.trace(P0[:2, :2]), "something is believed of them"
    assert ended[False] > nis_bound(2)
    assert 0.2 * nis_bound(2) < ended[True] <= nis_bound(2)


@pytest.mark.parametrize("off", [0.0, 0.8])
def test_links_that_are_likely_together_are_believed(off: float) -> None:
    """However far each of them is off: they ask for a gain, or a place, that may be."""
    x0, P0, links = moved_apart(0.0)
    links[:, measurement_update.LN] += off
    told = []
    for bounded in (False, True):
        x, P, out = x0.copy(), P0.copy(), seen_from(x0, P0, links)
        likelihood = take_in(x, P, N, Seen(links, lamp_table(), view()), out, bounded=bounded)
        told.append((likelihood, *x[:N], *P.ravel(), *out.ravel()))
    assert told[0] == told[1]


def test_the_noise_grows_with_what_is_improbable() -> None:
    """Nothing is thrown away where a little more noise is enough, and a softened link stays as much softer."""
    factors = []
    for by in (0.05, 0.2, 0.8):
        x, P, links = moved_apart(by)
        out = seen_from(x, P, links)
        out[1, measurement_update.WHITE] *= 10.0
        before = out[:, measurement_update.WHITE].copy()
        take_in(x, P, N, Seen(links, lamp_table(), view()), out, bounded=True)
        factors.append(out[:, measurement_update.WHITE] / before)
    assert factors[0] == pytest.approx((1.0, 1.0))
    for factor in factors:
        assert factor[0] == pytest.approx(factor[1])
    assert factors[0][0] <= factors[1][0] < factors[2][0]


@pytest.mark.parametrize("links", [1, 2, 3, 8, 24])
def test_the_bound_is_exceeded_once_in_a_thousand(links: int) -> None:
    assert nis_bound(links) == pytest.approx(chi2.ppf(0.999, links), rel=0.04)
