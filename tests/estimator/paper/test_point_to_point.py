"""Scan matching as printed: point-to-point (Eq. 13) and PIC."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.paper import pic, point_to_point, point_to_point_sums
from estimator.paper.first_transform import First
from estimator.paper.pose_weighting import Weight
from estimator.paper.registration import Pic, PointToPoint, points_of
from estimator.result import Reason
from estimator.scan_matching import icp
from estimator.scan_matching.distance_axis import build_axis
from estimator.scan_matching.scan_matcher import MatchSettings, Prior, ScanMatcher
from tests.estimator.world import map_of, place_both, prior_at, scan_in, view_of
from tools.bench.support.scenes import Scene, bearings, corridor, office, paper_room

WEAK = np.diag((4.0, 4.0, 10.0))
POINT = PointToPoint(weight=Weight.INFORMATION)
VAGUE = PointToPoint(weight=Weight.INFORMATION, first=lambda prior, frame: First(prior.T, WEAK))
"""Starts at the prediction and hardly weighs it."""


def small() -> tuple[point_to_point.New, point_to_point.Reference, First, Array]:
    """A few beams in the paper's room: both frames, T1 and the truth, in the reference lidar's frame."""
    rng, bearing, T = np.random.default_rng(5), bearings(121, 180.0), np.array((1.0, 0.5, 0.3))
    T_new = se2.compose(T, np.array((0.04, 0.02, 0.02)))
    frame = map_of([(T, scan_in(paper_room(), T, bearing, rng))]).newest
    assert frame is not None
    view = view_of(scan_in(paper_room(), T_new, bearing, rng))
    new = point_to_point.New(np.ascontiguousarray(view.points[:, :2]), view.T_base_lidar, view.beams, view.noise_m)
    return (
        new,
        point_to_point.reference_of(points_of(frame, 80.0), 0.01),
        First(np.zeros(3), WEAK),
        se2.between(T, T_new),
    )


def limits(cap: int = 40, scalar: bool = False) -> point_to_point.Limits:
    return point_to_point.Limits(cap, 0.5, 0.025, 2e-4, scalar)


def test_closed_form_is_the_least_squares_solution() -> None:
    """Against the definition: no small step away from it lowers the sum of squares; weights count."""
    rng = np.random.default_rng(0)
    q, w = rng.uniform(-3.0, 3.0, (20, 2)), rng.uniform(0.1, 1.0, 20)
    p = se2.apply(np.array((0.4, -0.2, 2.9)), q) + rng.normal(0.0, 0.05, (20, 2))
    moments, T = np.zeros(9), np.empty(3)
    for k in range(20):
        point_to_point_sums.add_pair(moments, w[k], (q[k, 0], q[k, 1]), (p[k, 0], p[k, 1]))
    assert point_to_point_sums.closed_form(moments, T)

    def cost(T: Array) -> float:
        return float(w @ ((se2.apply(T, q) - p) ** 2).sum(axis=1))

    least = cost(T)
    for d in 1e-4 * np.vstack((np.eye(3), -np.eye(3))):
        assert cost(T + d) > least
    assert not point_to_point_sums.closed_form(np.zeros(9), T)


def test_partners_are_the_nearest_points() -> None:
    new, reference, first, _ = small()
    _, partner = point_to_point.pair_up(new, reference, first.T, 0.3, None)
    moved = se2.apply(first.T, new.points)
    for xy, row in zip(moved, partner, strict=True):
        d = np.hypot(*(reference.axis.rows[:, :2] - xy).T)
        assert row == (np.argmin(d) if d.min() < 0.3 else -1)


def test_every_iteration_is_on_the_trace_and_it_ends() -> None:
    new, reference, first, truth = small()
    course, H = point_to_point.register(new, reference, first, limits())
    assert course.settled
    assert len(course.trace) < 40
    np.testing.assert_array_equal(course.trace[0][: icp.SCALE], first.T)
    assert all(row[icp.PAIRED] > 30 for row in course.trace)
    error = course.T - truth
    assert np.hypot(error[0], error[1]) < 0.06
    assert error @ H @ error < 25.0
    cut, _ = point_to_point.register(new, reference, first, limits(2))
    assert len(cut.trace) == 2
    assert not cut.settled
    none, _ = point_to_point.register(new, reference, first, limits(0))
    np.testing.assert_array_equal(none.T, first.T)


def test_a_step_that_turns_back_is_halved() -> None:
    """Pairs that alternate between two sets: the steps shrink until they end."""
    course = point_to_point.Course(np.zeros(3), 0.025, 2.0)
    for k in range(12):
        course.trace.append(np.zeros(icp.TRACE))
        point_to_point.advance(course, np.array((0.01 * (-1.0) ** k, 0.0, 0.0)), limits())
    assert course.damping == 0.125
    assert not course.settled
    assert course.sums[icp.LENGTH2] > 1.0


def test_with_light_the_scalar_weight_lies_between() -> None:
    new, reference, _, truth = small()
    told = First(truth + np.array((0.03, 0.0, 0.0)), np.diag((2e3, 2e3, 1e4)), 1.0, 6)
    log1, log2 = point_to_point.likelihoods(new, reference, told, truth)
    assert log1 < -0.5
    assert -8.0 < log2 < 1.0
    far, _ = point_to_point.likelihoods(new, reference, told, truth + np.array((0.5, 0.0, 0.0)))
    assert far < log1
    mixed, _ = point_to_point.register(new, reference, told, limits(20, scalar=True))
    alone, _ = point_to_point.register(new, reference, First(told.T, told.L), limits(20, scalar=True))
    toward = told.T - alone.T
    share = (mixed.T - alone.T)[:2] @ toward[:2] / (toward[:2] @ toward[:2])
    assert 0.1 < share < 1.05


def test_nothing_to_pair_is_no_result() -> None:
    new, reference, first, _ = small()
    away = First(np.array((50.0, 0.0, 0.0)), first.L)
    course, H = point_to_point.register(new, reference, away, limits())
    assert course.sums[icp.PAIRS] == 0.0
    np.testing.assert_allclose(H, 0.0, atol=1e-6)
    np.testing.assert_array_equal(course.T, away.T)


def trials(scene: Scene, beams: int, off: tuple[float, float], count: int) -> tuple[Array, Array]:
    """Squared Mahalanobis distances of the errors: by the information given, and by that of fixed pairs (Censi)."""
    rng, bearing, out = np.random.default_rng(8), bearings(beams, 180.0), []
    for _ in range(count):
        T, T_new = place_both(scene, rng, off[0], np.radians(off[1]))
        local, view = map_of([(T, scan_in(scene, T, bearing, rng))]), view_of(scan_in(scene, T_new, bearing, rng))
        result = VAGUE(view, local, prior_at(T, 0.5, 0.3), 50, MatchSettings())
        assert result.ok
        e = result.T_odom_base - T_new
        e[2] = se2.wrap(e[2])
        u = se2.apply(np.array((0.0, 0.0, result.T_odom_base[2])), view.points[:, :2])
        J = np.concatenate([np.column_stack((np.eye(2), (-y, x))) for x, y in u])
        out.append((e @ result.information @ e, e @ J.T @ J @ e / (2.0 * 0.01**2)))
    return np.array(out)[:, 0], np.array(out)[:, 1]


@pytest.mark.jit
@pytest.mark.parametrize("scene", [paper_room(), office()], ids=["room", "office"])
def test_the_covariance_does_not_lie(scene: Scene) -> None:
    """95 % of the errors inside the 95 % ellipse, 60 trials; the formula for fixed pairs has a few inside."""
    ours, fixed = trials(scene, 721, (0.1, 3.0), 60)
    assert np.mean(ours < 7.815) >= 0.88
    assert 1.0 < ours.mean() < 5.0
    assert np.mean(fixed < 7.815) < 0.5


@pytest.mark.jit
def test_a_plain_corridor_is_not_known_along_its_axis() -> None:
    """Where fixed pairs would claim millimetres; and there the pose is the prediction's."""
    rng, bearing, scene = np.random.default_rng(3), bearings(541, 180.0), corridor()
    for _ in range(8):
        T = np.array((rng.uniform(-5.0, 5.0), rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)))
        T_new = se2.compose(T, np.array((0.08, 0.01, 0.02)))
        seen = [scan_in(scene, at, bearing, rng) for at in (T, T_new)]
        for scan in seen:
            scan.beam[scan.range_m > 15.0] = 0
        told = Prior(T_new + np.array((0.03, 0.0, 0.0)), np.diag((1e4, 1e4, 1e5)))
        result = POINT(view_of(seen[1]), map_of([(T, seen[0])]), told, 50, MatchSettings())
        assert result.ok
        np.testing.assert_array_equal(result.known_axes, (0.0, 1.0, 1.0))
        assert abs(result.T_odom_base[0] - told.T[0]) < 0.005
        assert abs(result.T_odom_base[1] - T_new[1]) < 0.01


@pytest.mark.jit
@pytest.mark.parametrize("matcher", [VAGUE, PointToPoint(), Pic()], ids=["matrix", "literal", "pic"])
def test_bad_input_says_why(matcher: ScanMatcher) -> None:
    """A wrong guess of 3 m, three points, identical points: no exception, no confident wrong pose."""
    rng, bearing = np.random.default_rng(4), bearings(181, 180.0)
    T = np.array((1.0, 0.5, 0.2))
    local = map_of([(T, scan_in(paper_room(), T, bearing, rng))])
    view = view_of(scan_in(paper_room(), T, bearing, rng))
    wrong = prior_at(T + np.array((3.0, 0.0, 0.0)), 0.05, 0.05)
    result = matcher(view, local, wrong, 50, MatchSettings())
    assert not result.ok or np.abs(result.T_odom_base - T)[:2].max() < 0.1
    for points in (view.points[:3], np.repeat(view.points[:1], 50, axis=0), view.points[:0]):
        few = replace(view, points=np.ascontiguousarray(points))
        result = matcher(few, local, prior_at(T, 0.05, 0.05), 50, MatchSettings())
        assert np.isfinite(result.T_odom_base).all()
        assert np.isfinite(result.information).all()
        assert not result.ok or not result.known_axes.all()
    assert result.reason is Reason.TOO_FEW_PAIRS


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
