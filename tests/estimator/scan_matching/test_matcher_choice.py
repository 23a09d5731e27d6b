"""The paper's matcher and its baseline through the whole step, and beside the default one in rooms of known truth."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.mapping.keyframe import keep
from estimator.measurements import UNLIMITED, Array, Odometry
from estimator.numerics import se2
from estimator.pipeline import Settings, new_state, step
from estimator.result import Fix, LightsResult, Link, LinkState, Virtual
from estimator.scan_matching.matcher_choice import First, Matcher, Weight, first_of, match
from estimator.scan_matching.scan_matcher import Prior
from tests.estimator.world import map_of, moved, place_both, prior_at, scan_in, view_of
from tools.bench.support.scenes import Scene, bearings, office, paper_room

POINT, PIC = Settings(matcher=Matcher.POINT), Settings(matcher=Matcher.PIC)
LITERAL = Settings(matcher=Matcher.POINT, weight=Weight.PAPER)


def trial(
    scene: Scene, settings: Settings, off: tuple[float, float], rng: np.random.Generator, beams: int = 541
) -> tuple[Array, Array]:
    """Error of one match in the world's axes, and the information it claims."""
    T, T_new = place_both(scene, rng, off[0], np.radians(off[1]))
    bearing = bearings(beams, 270.0)
    local, view = map_of([(T, scan_in(scene, T, bearing, rng))]), view_of(scan_in(scene, T_new, bearing, rng))
    prior = prior_at(T, off[0], np.radians(off[1]))
    result = match((view, local, prior, 50, settings.matching), First(prior.T, prior.L), settings)
    assert result.ok, result.reason
    error = result.T_odom_base - T_new
    error[2] = se2.wrap(error[2])
    return error, result.information


@pytest.mark.jit
@pytest.mark.parametrize("settings", [POINT, PIC], ids=["point", "pic"])
@pytest.mark.parametrize("scene", [paper_room(), office()], ids=["room", "office"])
def test_both_find_the_place(scene: Scene, settings: Settings) -> None:
    rng = np.random.default_rng(1)
    errors = np.array([trial(scene, settings, (0.1, 2.0), rng)[0] for _ in range(20)])
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.04
    assert np.degrees(np.abs(errors[:, 2])).max() < 1.0


@pytest.mark.jit
@pytest.mark.parametrize("settings", [POINT, LITERAL, PIC], ids=["point", "literal", "pic"])
def test_a_drive_is_followed_by_each(settings: Settings) -> None:
    """Three metres in the paper's room with wheels that slip: the matchers keep the pose within centimetres."""
    scene, rng, bearing = paper_room(), np.random.default_rng(2), bearings(361, 270.0)
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
@pytest.mark.parametrize("settings", [POINT, LITERAL, PIC], ids=["point", "literal", "pic"])
def test_the_cap_is_obeyed(settings: Settings) -> None:
    rng, bearing = np.random.default_rng(3), bearings(181, 180.0)
    T = np.array((1.0, 0.5, 0.2))
    local = map_of([(T, scan_in(paper_room(), T, bearing, rng))])
    prior = prior_at(moved(T, rng, 0.1, 0.05), 0.1, 0.05)
    view = view_of(scan_in(paper_room(), T, bearing, rng))
    first = First(prior.T, prior.L, 1.0, 4)
    for cap in (0, 1, 3):
        assert match((view, local, prior, cap, settings.matching), first, settings).iterations <= cap
    whole, cut = (match((view, local, prior, cap, POINT.matching), first, POINT) for cap in (50, 2))
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
    asked = view, local, prior, 50, POINT.matching
    by = {k: match(asked, light, Settings(matcher=Matcher.POINT, weight=k)) for k in Weight}
    assert 0.01 < by[Weight.PAPER].T_odom_base[0] - T_new[0] < 0.029
    assert abs(by[Weight.INFORMATION].T_odom_base[0] - T_new[0]) < 0.006


def seen_by_light(T: Array, sd: float) -> Virtual:
    return Virtual(T, np.diag((sd**2, sd**2, (0.2 * sd) ** 2)), frozenset({1, 2}))


def links(*deviations: float) -> LightsResult:
    used = [Link(k, k, LinkState.ACCEPTED, 1e-6, 0.02 * d, 0.02) for k, d in enumerate(deviations)]
    out = Link(9, 9, LinkState.OCCLUDED, 1e-7, -0.5, 0.02)
    P = np.eye(3)
    return LightsResult(0.0, Fix.GOOD, np.zeros(3), P, (*used, out), frozenset(), np.zeros((3, 3)), np.zeros(3))


def test_the_first_transform_is_lights_relative_pose_hung_on_the_keyframe() -> None:
    """T1 = X_ref^-1 X_new in the odom frame, whatever lies between odom and map; occluded links have no say."""
    scan = scan_in(paper_room(), np.zeros(3), bearings(19, 180.0), None)
    T_odom, made, X_ref = np.array((1.0, 2.0, 0.5)), np.array((0.2, 0.05, 0.1)), np.array((-3.0, 1.0, -2.0))
    frame = keep(1, T_odom, T_odom, scan, 0.0)
    frame.virtual = seen_by_light(X_ref, 0.03)
    now = seen_by_light(se2.compose(X_ref, made), 0.04)
    prior = Prior(T_odom, np.eye(3))
    first = first_of(prior, frame, now, links(1.0, -1.0, 2.0))
    np.testing.assert_allclose(first.T, se2.compose(T_odom, made), atol=1e-12)
    assert first.links == 3
    assert first.misfit == pytest.approx(2.0)
    P = np.linalg.inv(first.L)
    assert 0.05**2 < P[0, 0] < 0.06**2
    np.testing.assert_allclose(P[0, 1], P[1, 0], atol=1e-12)


def test_without_light_the_first_transform_is_the_prediction() -> None:
    scan = scan_in(paper_room(), np.zeros(3), bearings(19, 180.0), None)
    frame, prior = keep(1, np.zeros(3), np.zeros(3), scan, 0.0), Prior(np.ones(3), np.eye(3))
    good = seen_by_light(np.zeros(3), 0.03)
    for newest, now, told in ((None, good, links(1.0)), (frame, good, links(1.0)), (frame, None, None)):
        first = first_of(prior, newest, now, told)
        assert first.T is prior.T
        assert first.links == 0
    frame.virtual = good
    for told in (None, links()):
        first = first_of(prior, frame, good, told)
        assert first.T is prior.T
        assert first.links == 0
