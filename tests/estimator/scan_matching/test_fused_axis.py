"""The paper's fused axis (Eq. 10-12): order, light points, quality filter, and the nearest neighbour it gives."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.scan_matching.distance_axis import build_axis
from estimator.scan_matching.distance_region import Kind, fuse, pair_fused
from estimator.scan_matching.nearest_neighbour import nearest_slow

COARSE = st.integers(-6, 6).map(lambda n: n * 0.25)  # duplicates, ties and points in the centre are common
POINTS = st.integers(0, 25).flatmap(lambda n: arrays(np.float64, (n, 2), elements=COARSE))
LIGHTS = st.integers(0, 4).flatmap(lambda n: arrays(np.float64, (n, 2), elements=COARSE))
POSES = st.tuples(COARSE, COARSE, st.sampled_from([0.0, 0.5 * np.pi, 0.3])).map(np.array)


@given(POINTS, POINTS, LIGHTS, POSES, st.sampled_from([np.inf, 0.3]), st.sampled_from([np.inf, 1.0, 0.25]))
@settings(max_examples=200, deadline=None)
def test_partners_are_the_nearest_that_pass_the_filter(
    reference: Array, points: Array, lights: Array, T: Array, bound: float, far: float
) -> None:
    axis = build_axis(reference, np.zeros(2), 1, lights)
    fused = fuse(axis, points, T, far)
    row, distance, visits = pair_fused(axis, fused, bound)
    seen = reference[np.hypot(*reference.T) <= far]
    kept = np.hypot(*points.T) <= far
    virtual = se2.apply(T, points)
    _, expected = nearest_slow(seen, virtual, bound)
    np.testing.assert_allclose(distance, np.where(kept, expected, bound), rtol=0, atol=1e-12)
    assert np.array_equal(row >= 0, kept & (expected < bound))
    hit = row >= 0
    partner = reference[axis.label[row[hit]]]
    np.testing.assert_allclose(np.hypot(*(partner - virtual[hit]).T), expected[hit], rtol=0, atol=1e-12)
    assert (visits[~kept] == 0).all()
    assert (visits >= hit).all()
    assert (visits <= len(seen)).all()


@given(POINTS, POINTS, LIGHTS, POSES)
@settings(max_examples=100, deadline=None)
def test_the_axis_holds_every_point_once_in_order_and_the_lights_flagged(
    reference: Array, points: Array, lights: Array, T: Array
) -> None:
    axis = build_axis(reference, np.array((0.25, -0.5)), 1, lights)
    fused = fuse(axis, points, T)
    assert (np.diff(fused.distance) >= 0.0).all()
    sources = {Kind.VIRTUAL: fused.virtual, Kind.REFERENCE: axis.rows[:, :2], Kind.LIGHT: axis.lights[:, :2]}
    for kind, source in sources.items():
        of_kind = fused.kind == kind
        member = fused.member[of_kind]
        assert np.array_equal(np.sort(member), np.arange(len(source)))
        np.testing.assert_allclose(np.hypot(*source[member].T), fused.distance[of_kind], atol=1e-12)
    np.testing.assert_allclose(axis.lights[:, :2] + axis.centre, lights)
    r = np.hypot(*fused.virtual.T)
    assert np.array_equal(fused.below, [(axis.rows[:, 2] <= d).sum() for d in r])


def test_the_order_of_the_iteration_before_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    axis = build_axis(rng.normal(0.0, 2.0, (300, 2)), np.zeros(2), 1)
    points = rng.normal(0.0, 2.0, (200, 2))
    first = fuse(axis, points, np.array((0.1, 0.0, 0.05)), 3.0)
    T = np.array((0.12, 0.01, 0.04))
    cold, warm = fuse(axis, points, T, 3.0), fuse(axis, points, T, 3.0, first)
    assert np.array_equal(cold.distance, warm.distance)
    for one, other in zip(pair_fused(axis, cold), pair_fused(axis, warm), strict=True):
        assert np.array_equal(one, other)


def test_points_visited_are_those_whose_distance_differs_less_than_the_best() -> None:
    """As the reverse triangle inequality has it, and the first that ends the walk is not compared."""
    rng = np.random.default_rng(8)
    reference, points = rng.normal(0.0, 3.0, (300, 2)), rng.normal(0.0, 3.0, (100, 2))
    axis = build_axis(reference, np.zeros(2), 1)
    row, distance, visits = pair_fused(axis, fuse(axis, points, np.zeros(3)))
    gap = np.abs(axis.rows[:, 2] - np.hypot(*points.T)[:, None])
    within = (gap < distance[:, None]).sum(axis=1)
    assert (visits >= within).all()
    assert (visits <= within + 2).all()
    assert (row >= 0).all()


def test_a_light_on_top_of_a_laser_point_is_not_its_partner() -> None:
    light = np.array(((1.0, 0.0),))
    axis = build_axis(np.array(((3.0, 0.0),)), np.zeros(2), 1, light)
    fused = fuse(axis, light, np.zeros(3))
    row, distance, _ = pair_fused(axis, fused)
    assert row.tolist() == [0]
    assert distance.tolist() == [2.0]
    assert fused.kind.tolist() == [Kind.VIRTUAL, Kind.LIGHT, Kind.REFERENCE]


def test_an_axis_with_sectors_is_refused_by_name() -> None:
    axis = build_axis(np.ones((100, 2)), np.zeros(2), 32)
    with pytest.raises(ValueError, match="32 sectors"):
        fuse(axis, np.ones((3, 2)), np.zeros(3))
