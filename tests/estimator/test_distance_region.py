"""The distance axis gives the nearest neighbour that comparing every pair gives, however many sectors it has."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from estimator.distance_axis import build_axis, sector_count, turn_of
from estimator.distance_region import nearest_all, nearest_slow, query_axis
from estimator.records import Array

COARSE = st.integers(-6, 6).map(lambda n: n * 0.25)  # duplicates, ties and points on sector bounds are common
POINTS = st.integers(0, 40).flatmap(lambda n: arrays(np.float64, (n, 2), elements=COARSE))
CENTRES = arrays(np.float64, 2, elements=COARSE)
SECTORS = st.sampled_from([0, 1, 16, 18, 21, 64])


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
@pytest.mark.parametrize("sectors", [0, 1, 16, 256])
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


def test_turn_grows_with_the_angle() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 97)[:-1]
    turns = [turn_of(float(np.cos(a)), float(np.sin(a))) for a in angle]
    assert (np.diff(turns) > 0.0).all()
    assert turns[0] == 0.0
    np.testing.assert_allclose(turns[24::24], (1.0, 2.0, 3.0), atol=1e-12)
    assert turn_of(0.0, 0.0) == 0.0
