"""The paper's baseline against its equations written down, and what its covariance is worth."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.paper import pic
from estimator.paper.registration import Pic
from estimator.scan_matching import icp
from estimator.scan_matching.distance_axis import build_axis
from estimator.scan_matching.scan_matcher import MatchSettings
from tests.estimator.world import map_of, place_both, prior_at, scan_in, view_of
from tools.bench.support.scenes import bearings, paper_room

NOISE, ACROSS = 0.02, 0.01


def covariance_of(x: float, y: float) -> Array:
    """J_r P_r J_r' of a point seen at (x, y) by a lidar at the origin, from its range and bearing."""
    r, a = np.hypot(x, y), np.arctan2(y, x)
    J = np.array(((np.cos(a), -r * np.sin(a)), (np.sin(a), r * np.cos(a))))
    return np.asarray(J @ np.diag((NOISE**2, ACROSS**2)) @ J.T)


def sum_up_slow(points: Array, reference: Array, T: Array, P: Array, eye: Array) -> tuple[Array, Array]:
    """Normal equations by the paper's definitions, every pair looked at."""
    A, b, R = np.zeros((3, 3)), np.zeros(3), se2.rotation(T[2])[:2, :2]
    for point in points:
        u = R @ point
        J = np.array(((1.0, 0.0, -u[1]), (0.0, 1.0, u[0])))
        c, ray = u + T[:2], R @ (point - eye)
        P_c = J @ P @ J.T + covariance_of(*ray)
        chosen, weight, spread = [], [], []
        for p in reference:
            S = P_c + covariance_of(*p)
            d2 = (p - c) @ np.linalg.solve(S, p - c)
            if d2 <= pic.COMPATIBLE:
                chosen.append(p)
                weight.append(np.exp(-0.5 * d2) / np.sqrt(np.linalg.det(S)))
                spread.append(covariance_of(*p))
        if not chosen:
            continue
        pi = np.array(weight) / sum(weight)
        a = pi @ np.array(chosen)
        P_a = sum(w * (np.outer(p - a, p - a) + own) for w, p, own in zip(pi, chosen, spread, strict=True))
        W = np.linalg.inv(P_a + P_c)
        A, b = A + J.T @ W @ J, b + J.T @ W @ (a - c)
    return A, b


@pytest.mark.parametrize("sectors", [1, 32, 64])
def test_sums_are_those_of_the_definitions(sectors: int) -> None:
    rng = np.random.default_rng(0)
    reference = rng.uniform(-4.0, 4.0, (60, 2))
    points = np.zeros((25, 4))
    points[:, :2] = reference[:25] + rng.normal(0.0, 0.05, (25, 2))
    T, eye = np.array((0.06, -0.04, 0.02)), np.array((0.1, 0.05))
    L = rng.normal(size=(3, 3)) * 0.02
    P = L @ L.T + 1e-4 * np.eye(3)
    axis = build_axis(reference, np.zeros(2), sectors)
    A, b = np.empty((3, 3)), np.empty(7)
    how = np.array((10.0, NOISE, ACROSS, 1e-4, *eye))
    pic.sum_up(points, (axis.rows, axis.start, axis.rays), T, P, how, (A, b))
    expected, gradient = sum_up_slow(points[:, :2], reference, T, P, eye)
    np.testing.assert_allclose(A, expected, rtol=1e-6)
    np.testing.assert_allclose(b[:3], gradient, rtol=1e-6, atol=1e-6)
    assert b[4] >= 15


def test_it_ends_where_the_points_are() -> None:
    """Exact points, displaced: found, with every iteration on the trace; a cap of two is kept."""
    reference = np.random.default_rng(1).uniform(-4.0, 4.0, (40, 2))
    truth, points = np.array((0.05, -0.03, 0.02)), np.zeros((40, 4))
    points[:, :2] = se2.apply(se2.inverse(truth), reference)
    axis = build_axis(reference, np.zeros(2))
    for cap, settled in ((60, True), (2, False)):
        T, H, sums, trace = np.zeros(3), np.zeros((3, 3)), np.zeros(icp.SUMS), np.zeros((cap, icp.TRACE))
        how = np.array((cap, 0.01, 0.002, 1e-5, 0.0, 0.0))
        rays = axis.rows, axis.start, axis.rays
        n = pic.iterate(points, rays, T, np.diag((0.01, 0.01, 0.001)), how, (H, sums, trace))
        assert n <= cap
        assert bool(sums[icp.SETTLED]) == settled
        assert (trace[:n, icp.PAIRED] > 30).all()
        if settled:
            np.testing.assert_allclose(T, truth, atol=2e-3)
            assert np.linalg.eigvalsh(H).min() > 0.0


@pytest.mark.jit
def test_it_converges_and_its_covariance_is_of_the_right_size() -> None:
    """In a room: millimetres; pairs along walls make its covariance too small, though not by an order."""
    rng, bearing = np.random.default_rng(2), bearings(721, 180.0)
    errors, squares = [], []
    for _ in range(40):
        T, T_new = place_both(paper_room(), rng, 0.1, np.radians(3.0))
        local = map_of([(T, scan_in(paper_room(), T, bearing, rng))])
        view = view_of(scan_in(paper_room(), T_new, bearing, rng))
        prior = prior_at(T, 0.1, 0.05)
        result = Pic()(view, local, prior, 50, MatchSettings())
        assert result.ok
        e = result.T_odom_base - T_new
        e[2] = se2.wrap(e[2])
        errors.append(e)
        squares.append(e @ result.information @ e)
    e = np.array(errors)
    assert np.sqrt((e[:, :2] ** 2).sum(axis=1).mean()) < 0.004
    assert 1.0 < np.mean(squares) < 10.0
