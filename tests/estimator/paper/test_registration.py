"""The paper's registration of scans, from its first transform on."""

import numpy as np
import pytest

from estimator.mapping.keyframe import Keyframe, keep
from estimator.measurements import UNLIMITED, Array, Odometry
from estimator.numerics import se2
from estimator.paper.first_transform import LIKELY, First, from_light, predicted
from estimator.paper.pose_weighting import Weight
from estimator.paper.registration import Pic, PointToPoint
from estimator.pipeline import Settings, new_state, step
from estimator.result import Reason, Virtual
from estimator.scan_matching import local_map
from estimator.scan_matching.scan_matcher import MatchSettings, Prior, ScanMatcher
from tests.estimator.world import map_of, moved, place_both, prior_at, scan_in, view_of
from tools.bench.support.scenes import Scene, bearings, office, paper_room

MATRIX, LITERAL, PIC = PointToPoint(weight=Weight.INFORMATION), PointToPoint(), Pic()
ALL = pytest.mark.parametrize("matcher", [MATRIX, LITERAL, PIC], ids=["matrix", "literal", "pic"])


def trial(
    scene: Scene, matcher: ScanMatcher, off: tuple[float, float], rng: np.random.Generator, beams: int = 541
) -> tuple[Array, Array]:
    """Error of one match in the world's axes, and the information it claims."""
    T, T_new = place_both(scene, rng, off[0], np.radians(off[1]))
    bearing = bearings(beams, 270.0)
    local, view = map_of([(T, scan_in(scene, T, bearing, rng))]), view_of(scan_in(scene, T_new, bearing, rng))
    prior = prior_at(T, off[0], np.radians(off[1]))
    result = matcher(view, local, prior, 50, MatchSettings())
    assert result.ok, result.reason
    error = result.T_odom_base - T_new
    error[2] = se2.wrap(error[2])
    return error, result.information


@pytest.mark.jit
@pytest.mark.parametrize("matcher", [MATRIX, PIC], ids=["matrix", "pic"])
@pytest.mark.parametrize("scene", [paper_room(), office()], ids=["room", "office"])
def test_both_find_the_place(scene: Scene, matcher: ScanMatcher) -> None:
    rng = np.random.default_rng(1)
    errors = np.array([trial(scene, matcher, (0.1, 2.0), rng)[0] for _ in range(20)])
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.04
    assert np.degrees(np.abs(errors[:, 2])).max() < 1.0


@pytest.mark.jit
@ALL
def test_a_drive_is_followed_by_each(matcher: ScanMatcher) -> None:
    """Three metres in the paper's room with wheels that slip: the matchers keep the pose within centimetres."""
    scene, rng, bearing = paper_room(), np.random.default_rng(2), bearings(361, 270.0)
    settings = Settings(match=matcher, newest_only=True)
    state, T, first = new_state(settings), np.array((-1.0, 0.3, 0.1)), np.array((-1.0, 0.3, 0.1))
    results = []
    for k in range(30):
        made = np.array((0.1, 0.0, 0.05))
        odometry = Odometry(0.1 * k, 0.1 * k + 0.1, made * (1.05, 1.0, 0.97))
        T = se2.compose(T, made)
        scan = scan_in(scene, T, bearing, rng, t=0.1 * k + 0.1)
        results.append(step(state, [odometry, scan], UNLIMITED))
    off = se2.between(se2.between(first, T), results[-1].T_odom_base)
    start = se2.between(first, se2.compose(first, np.array((0.1, 0.0, 0.05))))
    drift = off - (results[0].T_odom_base - start)
    assert np.hypot(drift[0], drift[1]) < 0.06
    assert abs(drift[2]) < 0.02
    assert all(r.match is not None and r.match.ok for r in results[1:])
    assert len(state.map.keyframes) > 5
    assert sum(r.keyframe >= 0 for r in results) <= 11, "each new reference keeps its error: one per quarter metre"


@pytest.mark.jit
@ALL
def test_the_cap_is_obeyed(matcher: ScanMatcher) -> None:
    rng, bearing = np.random.default_rng(3), bearings(181, 180.0)
    T = np.array((1.0, 0.5, 0.2))
    local = map_of([(T, scan_in(paper_room(), T, bearing, rng))])
    prior = prior_at(moved(T, rng, 0.1, 0.05), 0.1, 0.05)
    view = view_of(scan_in(paper_room(), T, bearing, rng))
    for cap in (0, 1, 3):
        assert matcher(view, local, prior, cap, MatchSettings()).iterations <= cap
    lit = PointToPoint(weight=Weight.INFORMATION, first=lambda prior, frame: First(prior.T, prior.L, 1.0, 4))
    whole, cut = (lit(view, local, prior, cap, MatchSettings()) for cap in (50, 2))
    assert not cut.ok or np.trace(cut.information) < 0.1 * np.trace(whole.information)


@pytest.mark.jit
def test_the_paper_weighs_light_by_one_number() -> None:
    """With light that errs by 3 cm the scalar weight takes its error in; the matrix weight leaves it to the laser."""
    rng, bearing, scene = np.random.default_rng(4), bearings(361, 270.0), paper_room()
    T = np.array((0.5, 0.4, 0.3))
    local = map_of([(T, scan_in(scene, T, bearing, rng))])
    T_new = se2.compose(T, np.array((0.08, 0.02, 0.03)))
    view, prior = view_of(scan_in(scene, T_new, bearing, rng)), Prior(T_new, np.diag((1e3, 1e3, 1e3)))
    light = First(T_new + np.array((0.03, 0.0, 0.0)), np.diag((1e3, 1e3, 1e4)), 1.0, 8)
    matchers = {k: PointToPoint(weight=k, first=lambda prior, frame: light) for k in Weight}
    by = {k: matcher(view, local, prior, 50, MatchSettings()) for k, matcher in matchers.items()}
    assert 0.01 < by[Weight.PAPER].T_odom_base[0] - T_new[0] < 0.029
    assert abs(by[Weight.INFORMATION].T_odom_base[0] - T_new[0]) < 0.006
    assert 0.3 < matchers[Weight.PAPER].share < 1.0
    assert matchers[Weight.INFORMATION].share == 0.0


@ALL
def test_without_a_keyframe_there_is_no_map(matcher: ScanMatcher) -> None:
    prior = prior_at(np.zeros(3), 0.1, 0.1)
    view = view_of(scan_in(paper_room(), np.zeros(3), bearings(19, 180.0), None))
    result = matcher(view, local_map.empty(np.zeros(2)), prior, 50, MatchSettings())
    assert result.reason is Reason.NO_MAP
    np.testing.assert_array_equal(result.T_odom_base, prior.T)


def frame_at(T_odom: Array) -> Keyframe:
    return keep(1, T_odom, T_odom, scan_in(paper_room(), np.zeros(3), bearings(19, 180.0), None), 0.0)


def seen_by_light(T: Array, sd: float) -> Virtual:
    return Virtual(T, np.diag((sd**2, sd**2, (0.2 * sd) ** 2)), frozenset({1, 2, 3, 4}))


def test_the_first_transform_is_the_relative_pose_of_light_on_the_keyframe() -> None:
    """T1 = X_ref^-1 X_new in the odom frame, wherever the odom frame lies in the map."""
    T_odom, made, X_ref = np.array((1.0, 2.0, 0.5)), np.array((0.2, 0.05, 0.1)), np.array((-3.0, 1.0, -2.0))
    frame = frame_at(T_odom)
    frame.virtual = seen_by_light(X_ref, 0.03)
    first = from_light(frame, seen_by_light(se2.compose(X_ref, made), 0.04), 2.5)
    np.testing.assert_allclose(first.T, se2.compose(T_odom, made), atol=1e-12)
    assert (first.misfit, first.links) == (2.5, 4)


def test_its_covariance_is_that_of_both_poses() -> None:
    """Against drawn errors of both poses: the difference of the two has the covariance that T1 claims."""
    rng, made, X_ref = np.random.default_rng(1), np.array((0.8, 0.3, 0.4)), np.array((-3.0, 1.0, -2.0))
    frame = frame_at(np.array((1.0, 2.0, 0.5)))
    frame.virtual, now = seen_by_light(X_ref, 0.03), seen_by_light(se2.compose(X_ref, made), 0.04)
    claimed = np.linalg.inv(from_light(frame, now, 0.0).L) - LIKELY
    drawn = []
    for _ in range(4000):
        e1, e2 = (rng.multivariate_normal(np.zeros(3), one.covariance) for one in (frame.virtual, now))
        relative = se2.between(X_ref + e1, now.T_map_base + e2)
        drawn.append(se2.compose(frame.T_odom_keyframe, relative) - se2.compose(frame.T_odom_keyframe, made))
    np.testing.assert_allclose(np.cov(np.array(drawn).T), claimed, atol=0.08 * float(claimed.max()))


def test_without_light_the_first_transform_is_the_prediction() -> None:
    prior = Prior(np.ones(3), np.eye(3))
    first = predicted(prior, frame_at(np.zeros(3)))
    assert first.T is prior.T
    assert first.L is prior.L
    assert (first.misfit, first.links) == (0.0, 0)


def test_light_at_the_keyframe_is_required() -> None:
    with pytest.raises(AssertionError):
        from_light(frame_at(np.zeros(3)), seen_by_light(np.zeros(3), 0.1), 0.0)
