"""The distance axis gives the nearest neighbour that comparing every pair gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from estimator.distance_region import build_axis, nearest_slow, query_axis
from estimator.records import Array

GRID = st.integers(-6, 6).map(
    lambda n: n * 0.25
)  # coarse values: duplicates, ties and points on sector bounds are common
POINTS = st.integers(0, 40).flatmap(lambda n: arrays(np.float64, (n, 2), elements=GRID))


def agree(points: Array, queries: Array, centre: Array, sectors: int, bound: float = np.inf) -> None:
    found, distance = query_axis(build_axis(points, centre, sectors), queries, bound)
    _, expected = nearest_slow(points, queries, bound)
    np.testing.assert_allclose(distance, expected, rtol=0, atol=1e-12)
    hit = found >= 0
    assert np.array_equal(hit, expected < bound)
    np.testing.assert_allclose(np.hypot(*(points[found[hit]] - queries[hit]).T), expected[hit], rtol=0, atol=1e-12)


@given(
    POINTS,
    POINTS,
    arrays(np.float64, 2, elements=GRID),
    st.sampled_from([0, 1, 2, 3, 7, 64]),
    st.sampled_from([np.inf, 0.3, 1.0]),
)
@settings(max_examples=300, deadline=None)
def test_exact_with_duplicates_and_ties(
    points: Array, queries: Array, centre: Array, sectors: int, bound: float
) -> None:
    agree(points, queries, centre, sectors, bound)


def wall(n: int) -> Array:
    return np.column_stack((np.linspace(-5.0, 5.0, n), np.full(n, 1.0)))


def circle(n: int) -> Array:
    angle = np.linspace(-np.pi, np.pi, n)
    return 2.0 * np.column_stack((np.cos(angle), np.sin(angle)))


def corridor(n: int) -> Array:
    return np.vstack((wall(n // 2), wall(n // 2) * (1.0, -1.0)))


@pytest.mark.parametrize("shape", [wall, circle, corridor])
@pytest.mark.parametrize("sectors", [0, 1, 5, 256])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.17, -0.05), (3.0, 1.0), (40.0, -7.0)])
def test_exact_on_walls_circles_and_corridors(shape: object, sectors: int, offset: tuple[float, float]) -> None:
    points = shape(200)  # type: ignore[operator]  # parametrize has no types
    agree(points, points[::3] + offset, np.zeros(2), sectors)
