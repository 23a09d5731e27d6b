"""The matching kernels: pairs, sums, what may be trusted; accuracy and honesty in rooms whose truth is known."""

import numpy as np
import pytest

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.result import Reason
from estimator.scan_matching import icp
from estimator.scan_matching.local_map import LocalMap
from estimator.scan_matching.scan_matcher import Attempt, MatchSettings, Prior, View, attempt, match
from tests.estimator.world import map_of, place_both, prior_at, scan_in, view_of
from tools.bench.support.scenes import Scene, bearings, corridor, office, paper_room, round_room

WIDE = bearings(1081, 270.0)
SETTINGS = MatchSettings()


def pair_of(
    scene: Scene, bearing: Array, metres: float, degrees: float, rng: np.random.Generator
) -> tuple[LocalMap, View, Array, Array]:
    """Map seen from one pose, view from another, and both poses."""
    T, T_new = place_both(scene, rng, metres, np.radians(degrees))
    return map_of([(T, scan_in(scene, T, bearing, rng))]), view_of(scan_in(scene, T_new, bearing, rng)), T, T_new


def small_pair() -> tuple[LocalMap, View, Array]:
    local, view, T, _ = pair_of(paper_room(), bearings(91, 180.0), 0.05, 2.0, np.random.default_rng(5))
    centre = np.array((*local.axis.centre, 0.0))
    return local, view, T - centre


def reference_of(local: LocalMap) -> tuple[Array, np.ndarray, Array, Array]:
    axis = local.axis
    return axis.rows, axis.start, axis.rays, local.lines


def columns_of(view: View) -> Array:
    body = np.empty((6, len(view.points)))
    icp.lay_out(view.points, 0.0, 0.0, 1, body)
    return body


def test_points_are_laid_out_coarse_ones_first() -> None:
    _, view, _ = small_pair()
    eye, n = np.array((0.3, -0.2)), len(view.points)
    body = np.empty((6, n))
    lever = icp.lay_out(view.points, eye[0], eye[1], 4, body)
    order = np.concatenate([np.arange(k, n, 4) for k in range(4)])
    away = eye - view.points[:, :2]
    distance = np.hypot(*away.T)
    assert lever == pytest.approx(np.sqrt((distance**2).mean()))
    expected = np.column_stack((view.points[:, :2], away / distance[:, None], view.points[:, 2:]))
    np.testing.assert_allclose(body.T, expected[order], rtol=1e-12)
    icp.lay_out(view.points[:1], view.points[0, 0], view.points[0, 1], 1, body)
    np.testing.assert_array_equal(body[2:4, 0], 0.0)  # a point on the lidar itself faces nothing


def test_pairs_within_their_safe_radius_are_those_a_new_search_finds() -> None:
    """And the lines that are held for the sums are those of the pairs."""
    local, view, T = small_pair()
    body, n = columns_of(view), len(view.points)
    memory, rng = icp.memory_of(n), np.random.default_rng(0)
    kept = 0
    for _ in range(8):
        T = T + rng.normal(0.0, 1.0, 3) * (0.002, 0.002, 0.0005)
        before = memory[2].copy()
        sought = icp.pair_up(body, reference_of(local), T, 0.15**2, n, memory)
        assert sought == n - (memory[2] == before).all(axis=1).sum()
        kept += n - sought
        fresh = icp.memory_of(n)
        assert icp.pair_up(body, reference_of(local), T, 0.15**2, n, fresh) == n
        np.testing.assert_array_equal(memory[0], fresh[0])
        row, held = memory[0], memory[3]
        np.testing.assert_array_equal(held[icp.WEIGHT], np.where(row < 0, 0.0, local.lines[row, 3]))
        anchors = (local.lines[row, :2] * local.axis.rows[row, :2]).sum(axis=1)
        np.testing.assert_allclose(held[icp.OFFSET, row >= 0], anchors[row >= 0])
        np.testing.assert_array_equal(held[:2, row >= 0], local.lines[row, :2].T[:, row >= 0])
    assert kept > 2 * n


def test_sums_are_the_normal_equations() -> None:
    """Against the definition: gradient and information of the robust cost, by finite differences of the residuals."""
    local, view, T = small_pair()
    body, memory = columns_of(view), icp.memory_of(len(view.points))
    sums, scale = np.zeros(icp.SUMS), 0.03
    icp.pair_up(body, reference_of(local), T, 0.25, len(view.points), memory)
    icp.sum_up(body, memory[3], T, scale, len(view.points), sums)
    H, g, used, squares = np.zeros((3, 3)), np.zeros(3), 0, 0.0
    noise, weights, inliers = np.zeros((3, 3)), 0.0, 0
    for point, row in zip(view.points, memory[0], strict=True):
        if row < 0:
            continue
        n, anchor = local.lines[row, :2], local.axis.rows[row, :2]

        def residual(T: Array, point: Array = point, n: Array = n, anchor: Array = anchor) -> float:
            return float(n @ (se2.apply(T, point[None, :2])[0] - anchor))

        to_eye = T[:2] - se2.apply(T, point[None, :2])[0]
        tangent = se2.rotation(T[2])[:2, :2] @ point[2:]
        if n @ to_eye <= 0.0 or abs(n @ tangent) > icp.ASKEW:
            continue
        step = 1e-6
        J = np.array([(residual(T + d) - residual(T - d)) / (2 * step) for d in step * np.eye(3)])
        p = 1.0 / (icp.GRAZE + (1.0 - icp.GRAZE) * (n @ to_eye) ** 2 / (to_eye @ to_eye))
        robust = 1.0 / (1.0 + p * (residual(T) / scale) ** 2)
        w = p * local.lines[row, 3] * robust
        H, g, used = H + w * np.outer(J, J), g + w * J * residual(T), used + 1
        across = np.array((-n[1], n[0], float(n @ (se2.rotation(T[2])[:2, :2] @ point[:2]))))
        noise += w * local.lines[row, 2] * np.outer(across, across)
        squares, weights, inliers = squares + w * residual(T) ** 2, weights + robust, inliers + (robust > 0.2)
    assert used == sums[icp.PAIRS] > 50
    assert inliers == sums[icp.INLIERS]
    np.testing.assert_allclose(sums[:6], H[np.triu_indices(3)], rtol=1e-6)
    np.testing.assert_allclose(sums[6:12], noise[np.triu_indices(3)], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(sums[12:15], g, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(sums[icp.WEIGHTS : icp.SQUARES + 1], (weights, squares), rtol=1e-9)


def test_noise_alone_is_no_information() -> None:
    """A direction whose information the normals' noise explains is dropped, the others are kept as they were."""
    full, noise = np.diag((100.0, 0.4, 300.0)), np.diag((0.1, 0.3, 0.2))
    sums = np.zeros(21)
    sums[:6], sums[6:12] = full[np.triu_indices(3)], noise[np.triu_indices(3)]
    H, keep = np.empty((3, 3)), np.empty((3, 3))
    icp.trusted(sums, 2.0, H, keep)
    np.testing.assert_allclose(H, 2.0 * np.diag((99.9, 0.0, 299.8)), atol=1e-9)
    np.testing.assert_allclose(keep, np.diag((1.0, 0.0, 1.0)), atol=1e-12)
    sums[9] = 0.1
    icp.trusted(sums, 2.0, H, keep)
    np.testing.assert_allclose(H, 2.0 * np.diag((99.9, 0.3, 299.8)), atol=1e-9)
    np.testing.assert_allclose(keep, np.eye(3))


def test_a_small_match_finds_its_place() -> None:
    local, view, _ = small_pair()
    T_wrong = np.array((*local.axis.centre, 0.0)) + small_pair()[2]
    result = match(view, local, prior_at(T_wrong, 0.2, 0.1), 30, SETTINGS)
    assert result.ok
    assert result.iterations < 15
    assert result.inliers > 0.8 * result.queries
    np.testing.assert_array_equal(result.known_axes, 1.0)
    again = attempt(view, local, prior_at(T_wrong, 0.2, 0.1), 30, SETTINGS)
    np.testing.assert_array_equal((*again.T[:2], se2.wrap(again.T[2])), result.T_odom_base)


def test_the_trace_tells_every_iteration() -> None:
    """From each row the pairs and sums of its iteration can be made again."""
    local, view, T = small_pair()
    start = prior_at(T + np.array((*local.axis.centre, 0.0)), 0.2, 0.1)
    found = attempt(view, local, start, 30, SETTINGS)
    trace = found.trace
    assert trace.shape == (found.iterations, icp.TRACE)
    np.testing.assert_array_equal(trace[0, :3], T)
    np.testing.assert_allclose(trace[-1, icp.STEP2], found.sums[icp.LENGTH2])
    assert trace[0, icp.SOUGHT] == len(view.points) > trace[-1, icp.SOUGHT]
    assert (np.diff(trace[:, icp.SCALE]) <= 0.0).all()
    assert (trace[:, icp.STRIDE] == 1.0).all()
    assert_traced(local, view, trace)


def assert_traced(local: LocalMap, view: View, trace: Array) -> None:
    body = columns_of(view)
    for row in trace:
        n, sums, stride = len(view.points), np.zeros(icp.SUMS), int(row[icp.STRIDE])
        used = np.ascontiguousarray(body[:, ::stride])
        partner, memory = icp.paired(view.points, reference_of(local), row), icp.memory_of(n)
        sought = icp.pair_up(used, reference_of(local), row[:3].copy(), row[icp.GATE] ** 2, used.shape[1], memory)
        assert sought == used.shape[1] >= row[icp.SOUGHT]
        np.testing.assert_array_equal(partner[::stride], memory[0][: used.shape[1]])
        assert (np.delete(partner, np.s_[::stride]) == -1).all()
        icp.sum_up(used, memory[3], row[:3].copy(), row[icp.SCALE], used.shape[1], sums)
        told = row[icp.FITTED : icp.SQUARED + 1] / (stride, stride, 1.0, 1.0)
        np.testing.assert_allclose(told, sums[icp.INLIERS : icp.SQUARES + 1], rtol=1e-9)


@pytest.mark.jit
def test_few_points_do_while_the_pose_is_far_off() -> None:
    local, view, T, T_new = pair_of(office(), WIDE, 0.1, 3.0, np.random.default_rng(2))
    found = attempt(view, local, prior_at(T, 0.1, 0.1), 30, SETTINGS)
    strides = found.trace[:, icp.STRIDE]
    assert strides[0] == SETTINGS.coarse
    assert strides[-1] == 1.0
    assert (np.diff(strides) <= 0.0).all()
    assert found.trace[:, icp.SOUGHT].sum() < 3.5 * len(view.points)
    assert_traced(local, view, found.trace)
    assert np.abs(found.T - T_new)[:2].max() < 0.005


def errors(
    scene: Scene, bearing: Array, metres: float, degrees: float, trials: int
) -> tuple[Array, list[Attempt], list[Array]]:
    """Errors in the true body frame of so many matches, what each said of itself, and world-frame errors."""
    rng = np.random.default_rng(11)
    out, said, world = [], [], []
    for _ in range(trials):
        local, view, T, T_new = pair_of(scene, bearing, metres, degrees, rng)
        a = attempt(view, local, prior_at(T, 0.5, 0.3), 50, SETTINGS)
        out.append(se2.between(T_new, a.T))
        e = a.T - T_new
        e[2] = se2.wrap(e[2])
        world.append(e)
        said.append(a)
    return np.array(out), said, world


@pytest.mark.jit
def test_accuracy_of_two_full_scans() -> None:
    """1081 beams of 1 cm noise from 17 cm and 4 deg away: 1.2 mm and 0.009 deg RMS in the paper's room."""
    e, _, _ = errors(paper_room(), WIDE, 0.17, 4.0, 80)
    assert np.sqrt((e[:, :2] ** 2).sum(axis=1).mean()) < 1.2e-3
    assert np.degrees(np.sqrt((e[:, 2] ** 2).mean())) < 0.0095


@pytest.mark.jit
@pytest.mark.parametrize("beams", [181, 1081])
def test_a_plain_corridor_does_not_say_where_along_it(beams: int) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        x, yaw = rng.uniform(-5.0, 5.0), rng.uniform(-0.2, 0.2)
        T = np.array((x, rng.uniform(-0.3, 0.3), yaw))
        bearing, scene = bearings(beams, 180.0), corridor()
        local = map_of([(T, scan_in(scene, T, bearing, rng, 0.01))])
        T_new = se2.compose(T, np.array((0.12, 0.02, 0.02)))
        blind = view_of(scan_in(scene, T_new, bearing, rng, 0.01))
        near = np.hypot(blind.points[:, 0], blind.points[:, 1]) < 20.0  # the ends are out of sight
        view = View(np.ascontiguousarray(blind.points[near]), blind.T_base_lidar, blind.beams, blind.noise_m)
        predicted = T_new + np.array((0.05, 0.01, 0.005))
        result = match(view, local, prior_at(predicted, 0.05, 0.02), 50, SETTINGS)
        assert result.ok
        np.testing.assert_array_equal(result.known_axes, (0.0, 1.0, 1.0))
        assert abs(result.T_odom_base[0] - predicted[0]) < 0.02  # left to the prediction
        assert abs(result.T_odom_base[1] - T_new[1]) < 0.005


@pytest.mark.jit
def test_a_round_room_does_not_say_which_way() -> None:
    rng = np.random.default_rng(4)
    local, view, T, _ = pair_of(round_room(), WIDE, 0.05, 3.0, rng)
    result = match(view, local, prior_at(T, 0.1, 0.1), 50, SETTINGS)
    np.testing.assert_array_equal(result.known_axes, (1.0, 1.0, 0.0))


@pytest.mark.jit
def test_the_cap_is_kept_and_an_unfinished_match_claims_little() -> None:
    local, view, T, _ = pair_of(office(), WIDE, 0.17, 4.0, np.random.default_rng(8))
    prior = prior_at(T, 0.5, 0.3)
    whole, cut = match(view, local, prior, 50, SETTINGS), match(view, local, prior, 2, SETTINGS)
    assert whole.reason is Reason.CONVERGED
    assert cut.iterations <= 2
    assert not cut.ok or np.trace(cut.information) < 0.5 * np.trace(whole.information)
    assert match(view, local, prior, 0, SETTINGS).reason is Reason.TOO_FEW_PAIRS


@pytest.mark.jit
def test_a_strong_prediction_is_weighed_in() -> None:
    """Eq. 14: with equal information of both witnesses the pose lies between them."""
    local, view, T, T_new = pair_of(paper_room(), WIDE, 0.02, 0.5, np.random.default_rng(9))
    free = attempt(view, local, prior_at(T, 0.5, 0.3), 50, SETTINGS)
    pulled = attempt(view, local, Prior(free.T + np.array((0.002, 0.0, 0.0)), free.H), 50, SETTINGS)
    assert 0.0005 < pulled.T[0] - free.T[0] < 0.0015
    assert np.abs(free.T - T_new)[:2].max() < 0.005
