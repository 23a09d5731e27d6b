"""The distance axis gives the nearest neighbour that comparing every pair gives, however many sectors it has."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from estimator.measurements import Array
from estimator.scan_matching.distance_axis import build_axis, sector_count, turn_of
from estimator.scan_matching.nearest_neighbour import nearest, nearest_all, nearest_slow, query_axis, search

COARSE = st.integers(-6, 6).map(lambda n: n * 0.25)  # duplicates, ties and points on sector bounds are common
POINTS = st.integers(0, 40).flatmap(lambda n: arrays(np.float64, (n, 2), elements=COARSE))
CENTRES = arrays(np.float64, 2, elements=COARSE)
SECTORS = st.sampled_from([0, 1, 32, 34, 45, 64])


def agree(points: Array, queries: Array, centre: Array, sectors: int, bound: float = np.inf) -> None:
    found, distance, _ = query_axis(build_axis(points, centre, sectors), queries, bound)
    _, expected = nearest_slow(points, queries, bound)
    np.testing.assert_allclose(distance, expected, rtol=0, atol=1e-12)
    hit = found >= 0
    assert np.array_equal(hit, expected < bound)
    np.testing.assert_allclose(np.hypot(*(points[found[hit]] - queries[hit]).T), expected[hit], rtol=0, atol=1e-12)


@given(POINTS, POINTS, CENTRES, SECTORS, st.sampled_from([np.inf, 0.3, 1.0]))
@settings(max_examples=200, deadline=None)
def test_exact_with_duplicates_and_ties(
    points: Array, queries: Array, centre: Array, sectors: int, bound: float
) -> None:
    agree(points, queries, centre, sectors, bound)


@given(POINTS, POINTS, CENTRES, SECTORS, st.sampled_from([4.0, 0.3]))
@settings(max_examples=200, deadline=None)
def test_the_bound_for_all_other_rows_is_true(
    points: Array, queries: Array, centre: Array, sectors: int, bound: float
) -> None:
    axis = build_axis(points, centre, sectors)
    row, visits = np.empty(len(queries), np.int64), np.empty(len(queries), np.int64)
    d2, e2 = np.empty(len(queries)), np.empty(len(queries))
    local = np.ascontiguousarray(queries - centre)
    nearest_all(axis.rows, axis.start, axis.rays, local, bound * bound, (row, d2, e2, visits))
    for i, q in enumerate(local):
        others = np.delete(axis.rows, row[i], axis=0) if row[i] >= 0 else axis.rows
        if len(others):
            least = ((others[:, :2] - q) ** 2).sum(axis=1).min()
            assert least >= min(e2[i], bound * bound) - 1e-12
        assert e2[i] >= d2[i] or row[i] < 0


CLOUDS = st.tuples(st.integers(0, 2**32 - 1), st.integers(1, 300), st.sampled_from([0.01, 0.3, 3.0]))


@given(CLOUDS, CENTRES, st.sampled_from([0, 1, 32, 100, 1000]), st.sampled_from([np.inf, 0.5]))
@settings(max_examples=100, deadline=None)
@pytest.mark.jit
def test_exact_in_clouds_of_many_densities_from_any_first_guess(
    cloud: tuple[int, int, float], centre: Array, sectors: int, bound: float
) -> None:
    """Points, dense or scattered, with some doubled; queries among them and far out; the guess may be any row."""
    seed, n, spread = cloud
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, spread, (n, 2)) + rng.normal(0.0, 2.0, 2)
    points[n // 2 :: 7] = points[0]
    queries = np.vstack((points[::5] + rng.normal(0.0, 0.02, 2), rng.normal(0.0, 4.0, (10, 2)), points[:2], centre))
    agree(points, queries, centre, sectors, bound)
    axis = build_axis(points, centre, sectors)
    for q in queries - centre:
        guess = int(rng.integers(n))
        d2 = float(((axis.rows[guess, :2] - q) ** 2).sum())
        row, found2, others2, visits = search(axis.rows, axis.start, axis.rays, q[0], q[1], guess, d2)
        distance2 = ((axis.rows[:, :2] - q) ** 2).sum(axis=1)
        assert found2 == pytest.approx(distance2.min(), abs=1e-12)
        assert distance2[row] == pytest.approx(found2, abs=1e-12)
        assert np.delete(distance2, row).min(initial=np.inf) >= others2 - 1e-12
        assert others2 >= found2
        assert 0 <= visits <= n + 1


@pytest.mark.parametrize("sectors", [0, 1, 32])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 8])
def test_few_points_and_the_edge_of_the_bound(n: int, sectors: int) -> None:
    """A point exactly at the bound is not nearer than it."""
    points = np.column_stack((np.arange(n) + 1.0, np.zeros(n)))
    axis = build_axis(points, np.zeros(2), sectors)
    row, d2, others2 = nearest(axis.rows, axis.start, axis.rays, 0.5, 0.0, 0.25)
    assert (row, d2) == (-1, 0.25)
    assert others2 >= 0.25
    row, d2, others2 = nearest(axis.rows, axis.start, axis.rays, 0.5, 0.0, 0.2501)
    assert d2 == (0.25 if n else 0.2501)
    assert (row == -1) == (n == 0)
    assert others2 >= d2


def test_sectors_that_are_too_wide_are_refused() -> None:
    with pytest.raises(ValueError, match="3 sectors are too wide"):
        build_axis(np.ones((40, 2)), np.zeros(2), 3)


def wall(n: int) -> Array:
    return np.column_stack((np.linspace(-5.0, 5.0, n), np.full(n, 1.0)))


def circle(n: int) -> Array:
    angle = np.linspace(-np.pi, np.pi, n)
    return 2.0 * np.column_stack((np.cos(angle), np.sin(angle)))


def corridor(n: int) -> Array:
    return np.vstack((wall(n // 2), wall(n // 2) * (1.0, -1.0)))


def one_place(n: int) -> Array:
    return np.full((n, 2), 0.5)


@pytest.mark.parametrize("shape", [wall, circle, corridor, one_place])
@pytest.mark.parametrize("sectors", [0, 1, 32, 256])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.17, -0.05), (3.0, 1.0), (40.0, -7.0)])
def test_exact_on_walls_circles_and_corridors(
    shape: Callable[[int], Array], sectors: int, offset: tuple[float, float]
) -> None:
    points = shape(200)
    agree(points, points[::3] + offset, np.zeros(2), sectors)


@pytest.mark.parametrize("n", [0, 1, 2, 63, 64, 1081, 5000])
def test_every_point_is_on_the_axis_once_and_in_order(n: int) -> None:
    rng = np.random.default_rng(n)
    points, centre = rng.normal(0.0, 5.0, (n, 2)), np.array((0.3, -2.0))
    axis = build_axis(points, centre)
    assert np.array_equal(np.sort(axis.label), np.arange(n))
    assert axis.start[0] == 0
    assert axis.start[-1] == n
    assert len(axis.start) == sector_count(n) + 1
    np.testing.assert_allclose(axis.rows[:, :2], points[axis.label] - centre)
    for low, high in zip(axis.start[:-1], axis.start[1:], strict=True):
        assert (np.diff(axis.rows[low:high, 2]) >= 0.0).all()


@pytest.mark.jit
def test_axes_that_are_gone_leave_nothing() -> None:
    cloud = np.random.default_rng(0).normal(0.0, 5.0, (4000, 2))
    build_axis(cloud[:100], np.zeros(2))
    tracemalloc.start()
    try:
        for n in range(100, 4000, 24):  # a number of sectors for each
            build_axis(cloud[:n], np.zeros(2))
        assert tracemalloc.get_traced_memory()[0] < 50_000
    finally:
        tracemalloc.stop()


def test_turn_grows_with_the_angle() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 97)[:-1]
    turns = [turn_of(float(np.cos(a)), float(np.sin(a))) for a in angle]
    assert (np.diff(turns) > 0.0).all()
    assert turns[0] == 0.0
    np.testing.assert_allclose(turns[24::24], (1.0, 2.0, 3.0), atol=1e-12)
    assert turn_of(0.0, 0.0) == 0.0
