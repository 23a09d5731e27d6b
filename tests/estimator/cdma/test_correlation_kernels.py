"""Each compiled loop against a slow twin that says the same in other words."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.cdma import code_period_kernels, correlation_kernels
from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.chip_pulse import STEPS, pulse_table
from estimator.cdma.gold_codes import gold_codes

TABLE = pulse_table(PROFILE_A)[None]


def waves(phase: list[float], rate: list[float], x: np.ndarray, signs: np.ndarray) -> SimpleNamespace:
    chips, out = gold_codes(7)[: len(phase)].copy(), np.empty((2, len(phase), len(x)))
    lamps, samples = np.array([phase, rate]), np.stack([x, np.ones_like(x)])
    bounds = correlation_kernels.columns(chips, lamps, samples, signs, TABLE, out)
    return SimpleNamespace(chips=chips, value=out[0], slope=out[1], bounds=bounds)


def slow_value(chips: np.ndarray, signs: np.ndarray, u: float) -> float:
    """Linear interpolation in the table, chip by chip over an endless code."""

    def pulse(column: int, fraction: float) -> float:
        return float(np.interp(fraction * STEPS, np.arange(STEPS + 1), TABLE[0, :, column]))

    def chip(at: int) -> float:
        return float(chips[at % 127] * signs[max(at // 127, 0)])

    k = int(np.floor(u))
    return chip(k) * pulse(0, u - k) + chip(k - 1) * pulse(1, u - k)


@given(
    times=st.lists(st.sampled_from([-math.inf, -2.0, -1.0, 0.0, 0.5, 1.0, 3.0, math.inf]), max_size=40).map(sorted),
    begin=st.integers(0, 40),
    limit=st.sampled_from([-math.inf, -1.5, -1.0, 0.0, 0.5, 2.0, 3.0, math.inf, math.nan]),
)
def test_the_first_time_from_a_limit_on(times: list[float], begin: int, limit: float) -> None:
    x, begin = np.array(times), min(begin, len(times))
    assert correlation_kernels.first_from(x, begin, limit) == begin + np.searchsorted(x[begin:], limit)
    x, begin = x[::2], min(begin, len(x[::2]))
    assert correlation_kernels.first_from(x, begin, limit) == begin + np.searchsorted(x[begin:], limit)


def test_columns_follow_the_code_with_its_signs() -> None:
    x = np.arange(-40.0, 40.0, 0.9)
    signs = np.array([[1.0, -1.0, 1.0], [-1.0, -1.0, 1.0]])
    got = waves([63.7, 130.2], [1.0, 1.001], x, signs)
    for i, (phase, rate) in enumerate([(63.7, 1.0), (130.2, 1.001)]):
        expected = [slow_value(got.chips[i], signs[i], phase + rate * t) for t in x]
        np.testing.assert_allclose(got.value[i], expected, atol=3e-4)
    assert got.bounds.tolist() == [[0, np.count_nonzero(63.7 + x < 127), 89, 89], [0, 41, 89, 89]]


@pytest.mark.parametrize(
    ("phase", "rate"),
    [(np.nan, 1.0), (1.0, np.nan), (1.0, np.inf), (np.inf, 1.0), (-np.inf, 1.0), (1e15, 1.0), (1.0, -1.0), (1.0, 1e12)],
)
def test_phases_that_cannot_be_point_out_of_no_table(phase: float, rate: float) -> None:
    """A kernel that reads beyond an array's end takes the whole process along."""
    got = waves([phase], [rate], np.arange(-40.0, 40.0, 0.9), np.ones((1, 3)))
    assert np.isfinite(got.value).all()
    assert got.bounds.min() >= 0
    assert got.bounds.max() <= got.value.shape[1]


def test_slopes_are_the_derivatives() -> None:
    x, signs = np.arange(-30.0, 30.0, 0.83), np.ones((1, 3))
    ahead, behind = waves([63.7 + 5e-3], [1.0], x, signs), waves([63.7 - 5e-3], [1.0], x, signs)
    middle = waves([63.7], [1.0], x, signs)
    np.testing.assert_allclose((ahead.value - behind.value) / 1e-2, middle.slope, atol=0.25)
    assert np.abs(middle.slope).max() > 5.0


def test_a_sign_of_zero_leaves_a_period_out_but_for_its_predecessors_tail() -> None:
    x = np.arange(-40.0, 40.0, 0.5)
    got = waves([120.0], [1.0], x, np.array([[1.0, 0.0, 0.0]]))
    begin = got.bounds[0, 1]
    assert np.abs(got.value[0, begin : begin + 2]).max() > 0.1
    assert not got.value[0, begin + 2 :].any()


def test_masked_samples_are_zero() -> None:
    x = np.arange(-20.0, 20.0, 0.5)
    out, samples = np.empty((2, 1, len(x))), np.stack([x, (np.arange(len(x)) % 3 > 0).astype(float)])
    lamps = np.array([[60.0], [1.0]])
    correlation_kernels.columns(gold_codes(7)[:1].copy(), lamps, samples, np.ones((1, 2)), TABLE, out)
    assert not out[:, 0, ::3].any()
    assert out[:, 0, 1::3].any()


@pytest.mark.parametrize(("rows", "free"), [(1, 1), (5, 2), (6, 6), (11, 7), (9, 1)])
def test_gram_is_the_matrix_product(rows: int, free: int) -> None:
    data = np.random.default_rng(rows).normal(size=(rows, 23))
    out = np.empty((rows, free))
    correlation_kernels.gram(data, free, out)
    np.testing.assert_allclose(out, data @ data[:free].T, atol=1e-12)


def test_gram_of_rows_that_are_mostly_zero() -> None:
    rng = np.random.default_rng(3)
    data, extent = np.zeros((9, 40)), np.zeros((2, 9), np.int64)
    for k, (low, high) in enumerate([(0, 9), (3, 3), (0, 40), (20, 31), (39, 40), (8, 21), (0, 1), (0, 40), (12, 30)]):
        data[k, low:high] = rng.normal(size=high - low)
        extent[:, k] = low, high
    out = np.empty((9, 7))
    correlation_kernels.gram_within(data, extent, 7, out)
    np.testing.assert_allclose(out, data @ data[:7].T, atol=1e-12)


@pytest.mark.parametrize("rows", [1, 3, 4, 6])
def test_inner_and_mixed_are_products_with_a_vector(rows: int) -> None:
    rng = np.random.default_rng(rows)
    data, row, weights = rng.normal(size=(rows, 23)), rng.normal(size=23), rng.normal(size=rows)
    np.testing.assert_allclose(correlation_kernels.inner(data, row), data @ row, atol=1e-12)
    np.testing.assert_allclose(correlation_kernels.mixed(weights, data), weights @ data, atol=1e-12)
    several, out = np.random.default_rng(rows).normal(size=(rows, rows)), np.empty_like(data)
    correlation_kernels.combine(several, data, out)
    np.testing.assert_allclose(out, several @ data, atol=1e-12)


def test_cut_puts_each_period_into_a_row_of_its_own() -> None:
    rng, x = np.random.default_rng(4), np.arange(-140.0, 140.0, 0.9)
    chips, lamps, n = gold_codes(7)[:2].copy(), np.array([[263.7, 141.0], [1.0, 1.001], [0.0, 0.0]]), len(x)
    samples, drive = np.stack([x, (rng.random(n) > 0.1).astype(float), rng.normal(size=n)]), np.array([3.0, 0.0])
    bounds, index = np.empty((2, 6), np.int64), np.empty((4, 10), np.int64)
    count = code_period_kernels.lay_out(chips, lamps, samples, 3, bounds, index)
    whole = waves(lamps[0].tolist(), lamps[1].tolist(), x, np.ones((2, 5)))
    np.testing.assert_array_equal(bounds, whole.bounds)
    touched = [(p, i) for p in range(5) for i in range(2) if p == 0 or bounds[i, p + 1] > bounds[i, p]]
    assert list(zip(index[1, :count], index[0, :count], strict=True)) == touched, "in order of time"
    out = np.full((count + 2, n), np.nan)
    code_period_kernels.cut(chips, lamps, samples, index, count, TABLE, drive, out)
    driven = np.zeros(n)
    for row, i, p, low, high in zip(out, *index[:, :count], strict=False):
        signs = np.zeros((2, 5))
        signs[:, p] = 1.0
        alone = waves(lamps[0].tolist(), lamps[1].tolist(), x, signs)
        np.testing.assert_allclose(row, alone.value[i] * samples[1], atol=1e-12)
        assert not row[:low].any()
        assert not row[high:].any()
        driven += drive[i] * np.where(row @ samples[2] < 0.0, -1.0, 1.0) * alone.slope[i] * samples[1]
    np.testing.assert_allclose(out[count], driven, atol=1e-9)
    np.testing.assert_allclose(out[count + 1], driven * x, atol=1e-7)


def slow_signs(
    soft: np.ndarray, variance: np.ndarray, size: np.ndarray, earlier: np.ndarray, long: float
) -> np.ndarray:
    weight = np.where(size > long, 1.0 / variance, 0.0)
    usual = (np.sum(np.abs(soft) * weight, axis=1) / np.maximum(np.sum(weight, axis=1), 1e-30))[:, None]
    sigma, strength = np.sqrt(variance), np.abs(soft)
    alike = np.abs(strength - usual) < code_period_kernels.SURE * sigma + code_period_kernels.ALIKE * usual
    certain = (size > long) | (alike & (strength > code_period_kernels.SURE * sigma))
    certain[:, 0] |= np.abs(earlier[0]) > code_period_kernels.SURE * np.sqrt(earlier[1])
    certain[:, 1:] |= size[:, 1:] == 0
    total = soft / variance
    total[:, 0] += earlier[0]
    return np.where(total < 0.0, -1.0, 1.0) * certain


@pytest.mark.parametrize("seed", range(8))
def test_signs_are_told_where_they_are_certain(seed: int) -> None:
    rng, lamps, periods = np.random.default_rng(seed), 9, 5
    size = rng.integers(0, 40, size=(lamps, periods))
    bounds = np.concatenate([np.zeros((lamps, 1), np.int64), np.cumsum(size, axis=1)], axis=1)
    touched = (size > 0) | (np.arange(periods) == 0)
    at = np.nonzero(touched)
    pieces = np.stack([rng.normal(scale=10.0, size=len(at[0])), rng.choice([0.2, 2.0, 30.0], size=len(at[0]))])
    earlier, out = np.stack([rng.normal(scale=5.0, size=lamps), np.ones(lamps)]), np.empty((3, lamps, periods))
    code_period_kernels.decide_signs(np.ascontiguousarray(np.stack([*at, *at])), pieces, bounds, earlier, 20.0, out)
    soft, variance = np.zeros((lamps, periods)), np.full((lamps, periods), np.inf)
    soft[at], variance[at] = pieces
    np.testing.assert_array_equal(out[0], soft)
    np.testing.assert_array_equal(out[1], variance)
    np.testing.assert_array_equal(out[2], slow_signs(soft, variance, size, earlier, 20.0))
    assert {-1.0, 0.0, 1.0} == set(out[2].ravel().tolist())


def test_fold_weighs_what_was_said_before() -> None:
    rings, last = np.zeros((2, 3, 10)), np.full((3, 10), -1)
    soft, variance = np.array([[4.0, -6.0, 9.9]]), np.array([[2.0, 3.0, np.inf]])
    correlation_kernels.fold(np.array([1]), np.array([19]), soft, variance, 0.5, rings, last)
    correlation_kernels.fold(np.array([1]), np.array([20]), np.array([[1.0]]), np.array([[1.0]]), 0.5, rings, last)
    correlation_kernels.fold(np.array([1]), np.array([29]), np.array([[1.0]]), np.array([[4.0]]), 0.5, rings, last)
    np.testing.assert_allclose(rings[0, 1, [9, 0, 1]], [0.5 * 2.0 + 0.25, -2.0 + 1.0, 0.0])
    np.testing.assert_allclose(rings[1, 1, [9, 0, 1]], [0.5 * 0.5 + 0.25, 1 / 3 + 1.0, 0.0])
    assert not rings[:, [0, 2]].any()
    assert last[1, [9, 0, 1]].tolist() == [29, 20, -1]


def slow_align(waves: np.ndarray, y: np.ndarray, lamps: np.ndarray, period: float, shift: float) -> float:
    padded = np.pad(y.astype(float), 2 * waves.shape[1])

    def correlation(wave: np.ndarray, lag: float) -> float:
        low, share = int(np.floor(lag)), lag % 1.0
        at = [padded[k + 2 * waves.shape[1] :][: waves.shape[1]] @ wave for k in (low, low + 1)]
        return float((1.0 - share) * at[0] + share * at[1])

    total = 0.0
    for wave, begin, weight in zip(waves, *lamps, strict=True):
        begins = [begin - shift + p * period for p in range(-5, 9)]
        total += float(weight) * sum(abs(correlation(wave, at)) for at in begins if -period < at < len(y))
    return total


@pytest.mark.parametrize("n", [90, 31, 130])
def test_align_is_the_sum_of_correlations_at_each_shift(n: int) -> None:
    period, rng = 37.4, np.random.default_rng(n)
    waves, y = rng.normal(size=(2, 40)).astype(np.float32), rng.normal(size=n).astype(np.float32)
    lamps, score = np.array([[0.2, 36.9], [2.0, 1.0]]), np.empty(13)
    correlation_kernels.align(waves, y, lamps, period, score)
    slow = [slow_align(waves, y, lamps, period, 0.5 * (s - 6)) for s in range(13)]
    np.testing.assert_allclose(score, slow, rtol=1e-5)


def test_align_finds_the_shift_that_lamps_share() -> None:
    period, n, rng = 37.4, 110, np.random.default_rng(3)
    waves = rng.choice([-1.0, 1.0], size=(2, 37)).astype(np.float32)
    begin, y = np.array([5.0, 30.0]), np.zeros(n, np.float32)
    for wave, at in zip(waves, begin - 2.0, strict=True):
        for p in range(-1, 4):
            first = round(at + p * period)
            low = max(first, 0)
            high = max(min(first + 37, n), low)
            y[low:high] += (-1) ** p * wave[low - first : high - first]
    score = np.empty(13)
    correlation_kernels.align(waves, y, np.stack([begin, np.array([2.0, 1.0])]), period, score)
    assert 0.5 * (np.argmax(score) - 6) == 2.0


def test_invert_and_what_it_does_to_a_dependent_unknown() -> None:
    data = np.random.default_rng(1).normal(size=(6, 20))
    matrix = data @ data.T
    inverse = matrix.copy()
    correlation_kernels.invert(inverse)
    np.testing.assert_allclose(inverse @ matrix, np.eye(6), atol=1e-10)
    nothing = np.zeros((3, 3))
    nothing[0, 0] = nothing[2, 2] = 2.0
    correlation_kernels.invert(nothing)
    np.testing.assert_allclose(nothing, np.diag([0.5, 0.0, 0.5]))


def slow_detect(row: np.ndarray, n: int, period: float) -> tuple[float, float, float, float]:
    def total(lag: int) -> float:
        starts = [lag + int(np.floor(p * period + 0.5)) for p in range(-1, int(n / period) + 2)]
        return float(sum(abs(row[s]) for s in starts if -int(period) <= s < n))

    sums = [total(lag) for lag in range(-1, int(period) + 2)]
    best = 1 + int(np.argmax(sums[1:-1]))
    return best - 1, sums[best], sums[best - 1], sums[best + 1]


@pytest.mark.parametrize(("n", "period"), [(90, 37.4), (40, 37.4), (130, 25.0)])
def test_detect_sums_over_the_periods_touched(n: int, period: float) -> None:
    size = n + int(period) + 3
    correlation = np.random.default_rng(n).normal(size=(4, size)).astype(np.float32)
    out, nobody = np.empty((4, 5)), np.empty((2, 0))
    correlation_kernels.detect(correlation, nobody, 2.0, n, period, np.empty(int(period) + 3, np.float32), out)
    for row, found in zip(correlation, out, strict=True):
        np.testing.assert_allclose(found[:4], slow_detect(row, n, period), rtol=1e-5)
        np.testing.assert_allclose(found[4], np.sum(row[: max(n - int(period), 1)] ** 2), rtol=1e-5)


def test_detect_passes_over_lamps_that_are_known() -> None:
    """At each of their periods and ``guard`` samples to either side; of that code alone."""
    n, period = 90, 37.4
    size = n + int(period) + 3
    correlation = np.ones((2, size), np.float32)
    known, out = np.array([[1.0, -1.0], [4.3, 20.0]]), np.empty((2, 5))
    correlation_kernels.detect(correlation, known, 2.0, n, period, np.empty(int(period) + 3, np.float32), out)
    assert correlation[0].all()
    begins = np.round(4.3 + period * np.arange(-1, 3)).astype(int)
    muted = (begins[:, None] + np.arange(-2, 3)) % size
    assert set(np.flatnonzero(correlation[1] == 0.0)) == set(muted.ravel())
