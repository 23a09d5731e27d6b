"""What matches miss by and what they say of it: a few dozen trials each time, a thousand in the slow run."""

from functools import partial

import numpy as np
import pytest

from estimator.numerics.symmetric3 import invert3
from estimator.result import MatchResult, Reason
from estimator.scan_matching import icp
from estimator.scan_matching.scan_matcher import Attempt, attempt, match, verdict
from tools.bench.accuracy import claimed, endless
from tools.bench.support.bound import information
from tools.bench.support.scenes import Scene, bearings, office, paper_room, round_room
from tools.bench.support.trials import SETTINGS, Case, given, ours, run

pytestmark = pytest.mark.no_cover

ROOMS = pytest.mark.parametrize("scene", [paper_room(), office()], ids=["room", "office"])
MANY = pytest.param(1000, marks=pytest.mark.slow)


def test_the_bound_is_the_curvature_of_the_likelihood() -> None:
    """Against finite differences of true ranges, where no beam changes its surface."""
    scene, T, bearing = paper_room(), np.array((0.3, 0.2, 0.1)), bearings(181, 180.0)
    step, r = 1e-6, scene.ranges(T, bearing)
    moved = [scene.ranges(T + d, bearing) - scene.ranges(T - d, bearing) for d in step * np.eye(3)]
    J = np.array(moved) / (2.0 * step)
    ok = np.isfinite(r) & (np.abs(J).max(axis=0) < 1e3)
    np.testing.assert_allclose(information(scene, T, bearing, 0.01), J[:, ok] @ J[:, ok].T / 1e-4, rtol=0.02, atol=50.0)


@pytest.mark.jit
@ROOMS
@pytest.mark.parametrize(("count", "scans"), [(40, 1), (10, 10), pytest.param(1000, 1, marks=pytest.mark.slow)])
def test_errors_are_within_twice_the_cramer_rao_bound(scene: Scene, count: int, scans: int) -> None:
    found = run(Case(scene, scans=scans), count)
    assert found.rms()[0] < 2.0 * found.rms_bound()[0]
    assert found.rms()[1] < 2.0 * found.rms_bound()[1]
    assert found.confident_wrong == 0


@pytest.mark.jit
@ROOMS
@pytest.mark.parametrize("count", [80, MANY])
@pytest.mark.parametrize(("off", "least"), [((0.5, 20.0), 0.985), ((0.2, 5.0), 0.999)], ids=["far", "near"])
def test_the_place_is_found(scene: Scene, off: tuple[float, float], least: float, count: int) -> None:
    found = run(Case(scene, 181, 180.0, off), count)
    assert found.success >= least - (0.02 if count < 1000 else 0.0)
    assert found.confident_wrong <= count // 1000


@pytest.mark.jit
@ROOMS
@pytest.mark.parametrize(("sigma", "scans"), [(0.01, 1), (0.03, 1), (0.03, 4)])
@pytest.mark.parametrize("count", [80, MANY])
def test_19_of_20_errors_are_inside_their_ellipse(scene: Scene, sigma: float, scans: int, count: int) -> None:
    found = run(Case(scene, 361, 270.0, (0.1, 3.0), sigma, scans), count)
    assert found.ok.all()
    assert abs(found.inside - 0.95) < 0.03 + 2.5 * np.sqrt(0.05 * 0.95 / count)


@pytest.mark.jit
@pytest.mark.parametrize("sigma", [0.01, 0.03])
@pytest.mark.parametrize("count", [4, pytest.param(300, marks=pytest.mark.slow)])
def test_an_endless_corridor_is_blind_along_itself(sigma: float, count: int) -> None:
    """Whatever way it is turned, and however many scans the map is made of."""
    for angle in (0.0, 45.0):
        along = np.array((np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0))
        for beams, scans in ((181, 1), (1081, 1), (1081, 8)):
            found = run(Case(endless(angle), beams, 270.0, (0.1, 3.0), sigma, scans), count)
            assert found.ok.all()
            assert not claimed(found, along).any()
            for result in found.results:
                assert len(result.blind_directions()) == 1
                assert along @ invert3(result.information + 1e-3 * np.eye(3)) @ along > 0.2**2
                assert result.known_axes[2] == 1.0


@pytest.mark.jit
@pytest.mark.parametrize("count", [3, pytest.param(300, marks=pytest.mark.slow)])
def test_a_round_room_is_blind_to_the_turn_about_its_middle(count: int) -> None:
    for beams, scans in ((361, 1), (1081, 1), (361, 6)):
        found = run(Case(round_room(), beams, 270.0, (0.05, 3.0), 0.01, scans), count)
        for result in found.results:
            assert result.known_axes[2] == 0.0
            assert abs(result.blind_directions()[0, 2]) > 0.5


@pytest.mark.jit
@pytest.mark.parametrize("cap", [1, 2, 3, 5, 8, 15, 22, 30, 50])
def test_no_match_takes_more_than_it_may(cap: int) -> None:
    """Counted in points passed over, the trials of a second opinion included; what is cut short claims less."""
    case = Case(office(), 181, 180.0, (0.5, 20.0))
    for number in range(25):
        view, local, prior, _ = given(case, 11, number)
        tried: list[Attempt] = []
        result = match(view, local, prior, cap, SETTINGS, tried)
        assert result.iterations <= cap
        assert sum(each.iterations * each.points for each in tried) <= result.iterations * len(view.points)


@pytest.mark.jit
@pytest.mark.parametrize("cap", [2, 4])
def test_a_match_that_was_cut_short_is_not_confidently_wrong(cap: int) -> None:
    found = run(Case(office(), 361, 270.0, (0.2, 5.0)), 40, matcher=partial(match, cap=cap, settings=SETTINGS))
    assert found.confident_wrong == 0
    for result in found.results:
        assert result.reason is not Reason.CONVERGED or result.iterations <= cap


@pytest.mark.jit
def test_the_reason_is_the_reason() -> None:
    """A settled match converged; steps that turn back and forth oscillate; others ran into the cap."""
    view, local, prior, _ = given(Case(paper_room(), 181, 180.0, (0.05, 1.0)), 11, 0)

    def judged(settled: float, length2: float, damping: float) -> MatchResult:
        made = attempt(view, local, prior, 30, SETTINGS)
        made.sums[icp.SETTLED], made.sums[icp.LENGTH2], made.sums[icp.DAMPING] = settled, length2, damping
        return verdict(made, local, prior, SETTINGS)

    assert judged(1.0, 0.01, 1.0).reason is Reason.CONVERGED
    assert judged(0.0, 4.0, 1.0).reason is Reason.ITERATION_CAP
    assert judged(0.0, 0.5, 0.25).reason is Reason.ITERATION_CAP
    swinging = judged(0.0, 4.0, 0.25)
    assert swinging.reason is Reason.OSCILLATING
    assert not swinging.ok
    np.testing.assert_array_equal(swinging.T_odom_base, prior.T)
    np.testing.assert_array_equal(swinging.information, 0.0)
    whole, cut = judged(1.0, 0.0, 1.0), judged(0.0, 4.0, 1.0)
    np.testing.assert_allclose(cut.information * 5.0, whole.information)


@pytest.mark.jit
def test_a_second_opinion_costs_a_good_prediction_nothing() -> None:
    case = Case(office(), 361, 270.0, (0.02, 0.5), prior=(0.03, 0.02))
    for number in range(20):
        view, local, prior, _ = given(case, 11, number)
        tried: list[Attempt] = []
        assert match(view, local, prior, 50, SETTINGS, tried).ok
        assert len(tried) == 1
    assert ours(*given(case, 11, 0)[:3]).iterations < 8
