from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.light_filter.lambertian import expected
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.measurements import Array
from estimator.paper.adaptive_link_selection import adapted
from estimator.paper.lateration import (
    Circle,
    Doubt,
    Located,
    Prior,
    Received,
    Solver,
    SolverSettings,
    Why,
    locate,
    shortest,
    without_floor,
)
from estimator.paper.lateration_model import usable

EXACT = Doubt(0.0, 0.0, 0.0, 0.0)
GRID = (1.25, 3.75, 6.25, 8.75)
PAPER = tuple(
    Lamp(4 * i + j, 4 * i + j, x, y, 2.9, sigma_ln=0.03) for i, x in enumerate(GRID) for j, y in enumerate(GRID)
)


def survey_of(lamps: tuple[Lamp, ...], floor: float = 0.0, receiver: Receiver | None = None) -> Survey:
    return Survey(lamps, Receiver(z=0.3) if receiver is None else receiver, floor)


def receive(survey: Survey, xy: tuple[float, float] | Array, yaw: float = 0.0, noise: float = 1e-9) -> Received:
    """What arrives at a receiver without lever arm, of the lamps within its field of view."""
    e = expected(survey.lamps, survey, np.array((*xy, yaw)))
    seen = np.flatnonzero(e.direct > 0.0)
    return Received(tuple(survey.lamps[i] for i in seen), e.amplitude[seen], np.full(len(seen), noise**2))


def nearest(found: Located, xy: tuple[float, float] | Array) -> float:
    return min(float(np.hypot(*(place.xy - np.asarray(xy)))) for place in found.places)


lamp_rows = st.lists(
    st.tuples(
        st.floats(-4, 4), st.floats(-4, 4), st.floats(2.0, 4.0), st.floats(0.3, 4.0), st.floats(0.3, 2.0),
    ),
    min_size=3, max_size=7,
)  # fmt: skip


@settings(deadline=None, max_examples=60)
@given(rows=lamp_rows, x=st.floats(-3, 3), y=st.floats(-3, 3), solver=st.sampled_from(Solver))
@pytest.mark.jit
def test_exact_without_noise(rows: list[tuple[float, ...]], x: float, y: float, solver: Solver) -> None:
    """Lamps of different height, power and order: the truth is among what is found, and alone unless it is a mirror."""
    lamps = tuple(Lamp(i, i, r[0], r[1], r[2], power_w=r[3], order=r[4], sigma_ln=0.01) for i, r in enumerate(rows))
    receiver = Receiver(z=0.3, half_fov_rad=1.55)
    received = receive(survey_of(lamps, receiver=receiver), (x, y))
    found = locate(received, survey_of(lamps, receiver=receiver), SolverSettings(solver, None, rim=0.0, doubt=EXACT))
    xy = np.array([(p.x, p.y) for p in lamps])
    across = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
    if across[1] > 0.5:
        assert nearest(found, (x, y)) < 1e-4
        assert np.hypot(*(found.places[0].xy - (x, y))) < 1e-4 or found.why is Why.MIRROR


@pytest.mark.parametrize("solver", Solver)
def test_paper_room(solver: Solver) -> None:
    survey = survey_of(PAPER)
    for xy in ((5.1, 4.7), (1.0, 1.3), (8.4, 3.3), (0.4, 9.5)):
        found = locate(receive(survey, xy), survey, SolverSettings(solver))
        assert len(found.used) <= 4
        assert nearest(found, xy) < 1e-6


def test_floor_and_leaning_receiver_are_part_of_ml() -> None:
    receiver = Receiver(z=0.3, x=0.1, y=-0.05, slope_x=0.1, slope_y=0.05)
    survey = survey_of(PAPER, 0.016, receiver)
    yaw = 0.7
    received = receive(survey, (4.0, 6.0), yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    truth = (4.0 + c * 0.1 + s * 0.05, 6.0 + s * 0.1 - c * 0.05)
    found = locate(received, survey, SolverSettings(link_n=None, yaw=yaw))
    assert nearest(found, truth) < 1e-5
    wrong = locate(received, survey, SolverSettings(Solver.LS, yaw=yaw))
    assert nearest(wrong, truth) > 0.02


@pytest.mark.parametrize("solver", Solver)
def test_two_links_are_a_mirror_pair_that_a_prior_decides(solver: Solver) -> None:
    lamps = (Lamp(1, 1, 0.0, 0.0, 2.9), Lamp(2, 2, 2.0, 0.0, 2.9))
    survey = survey_of(lamps)
    received = receive(survey, (0.7, 1.2))
    found = locate(received, survey, SolverSettings(solver))
    assert found.why is Why.MIRROR
    assert sorted(round(float(p.xy[1]), 4) for p in found.places) == [-1.2, 1.2]
    near = Prior(np.array((0.5, 1.0)), 0.01 * np.eye(2))
    decided = locate(received, survey, SolverSettings(solver), near)
    assert decided.why is Why.PRIOR
    assert nearest(decided, (0.7, 1.2)) < 1e-6
    vague = Prior(np.array((0.5, 0.1)), 100.0 * np.eye(2))
    undecided = locate(received, survey, SolverSettings(solver), vague)
    assert undecided.why is Why.MIRROR
    assert undecided.places[0].xy[1] > 0.0


@pytest.mark.parametrize("solver", Solver)
def test_lamps_in_a_line_mirror_too(solver: Solver) -> None:
    lamps = tuple(Lamp(i, i, 1.5 * i, 0.75 * i, 2.9) for i in range(4))
    survey = survey_of(lamps)
    found = locate(receive(survey, (2.0, 2.0)), survey, SolverSettings(solver))
    assert found.why is Why.MIRROR
    assert len(found.places) == 2
    assert nearest(found, (2.0, 2.0)) < 1e-5


@pytest.mark.parametrize("solver", Solver)
def test_under_the_line_there_is_one_place_with_an_honest_covariance(solver: Solver) -> None:
    lamps = tuple(Lamp(i, i, 2.0 * i, 0.0, 2.9) for i in range(3))
    survey = survey_of(lamps)
    found = locate(receive(survey, (1.3, 0.0)), survey, SolverSettings(solver))
    assert nearest(found, (1.3, 0.0)) < 0.2
    along, across = np.sqrt(np.diag(found.places[0].covariance))
    assert 0.3 < across < 2.0
    assert along < 0.3


def test_one_link_is_a_circle_and_none_is_none() -> None:
    survey = survey_of((Lamp(1, 1, 1.0, 2.0, 2.9),))
    found = locate(receive(survey, (2.2, 2.0)), survey)
    assert found.why is Why.CIRCLE
    assert isinstance(found.circle, Circle)
    assert (found.circle.x, found.circle.y) == (1.0, 2.0)
    assert found.circle.radius == pytest.approx(1.2)
    assert 0.02 < found.circle.sigma < 0.5
    assert locate(Received((), np.empty(0), np.empty(0)), survey).why is Why.NONE


def test_unusable_strengths_are_left_out() -> None:
    survey = survey_of(PAPER[:6])
    received = receive(survey, (2.5, 3.0))
    for bad in (0.0, -1e-6, float("nan"), float("inf")):
        damaged = Received(received.lamps, received.amplitude.copy(), received.variance)
        damaged.amplitude[0] = bad
        found = locate(damaged, survey, SolverSettings(link_n=None))
        assert 0 not in found.used
        assert nearest(found, (2.5, 3.0)) < 0.01
    with pytest.raises(ValueError, match="6 lamps"):
        Received(PAPER[:6], np.ones(5), np.ones(6))


@settings(deadline=None, max_examples=150)
@given(
    places=st.lists(
        st.tuples(st.sampled_from((0.0, 1.0, 1e-9, -3.0, 50.0)), st.sampled_from((0.0, 1.0, 2.0))), max_size=6
    ),
    strengths=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=6, max_size=6),
    variance=st.sampled_from((0.0, 1e-20, 1.0, float("nan"))),
    solver=st.sampled_from(Solver),
    adaptive=st.booleans(),
    floor=st.sampled_from((0.0, 0.016)),
)
@pytest.mark.jit
def test_nothing_raises_and_what_is_returned_is_finite(
    places: list[tuple[float, float]],
    strengths: list[float],
    variance: float,
    solver: Solver,
    adaptive: bool,
    floor: float,
) -> None:
    lamps = tuple(Lamp(i, i, x, y, 2.9) for i, (x, y) in enumerate(places))
    received = Received(lamps, np.array(strengths[: len(lamps)]), np.full(len(lamps), variance))
    found = locate(received, survey_of(lamps, floor), SolverSettings(solver, None, adaptive, rim=0.0))
    for place in found.places:
        assert np.isfinite(place.xy).all()
        assert np.isfinite(place.covariance).all()
        assert np.linalg.eigvalsh(place.covariance)[0] >= 0.0
    assert (found.circle is not None) == (found.why is Why.CIRCLE)
    assert bool(found.places) == (found.why in (Why.PLACE, Why.MIRROR, Why.PRIOR))


def perturbed(received: Received, survey: Survey, doubt: Doubt, rng: np.random.Generator) -> Received:
    """Errors of exactly the kind that the model of errors describes (but for tilt)."""
    links = usable(received, survey, SolverSettings(doubt=doubt, rim=0.0))
    error = rng.multivariate_normal(np.zeros(len(links.at)), links.covariance(doubt))
    amplitude = received.amplitude.copy()
    amplitude[links.at] *= np.exp(error)
    return Received(received.lamps, amplitude, received.variance)


@pytest.mark.jit
@pytest.mark.parametrize(("solver", "link_n"), [(Solver.LS, 4), (Solver.LIN, 5), (Solver.ML, 4), (Solver.ML, None)])
def test_covariance_is_consistent(solver: Solver, link_n: int | None) -> None:
    """Mean normalised squared error is the dimension, 2, over many places and errors."""
    rng = np.random.default_rng(5)
    lamps = tuple(replace(lamp, sigma_ln=0.02) for lamp in PAPER)
    doubt = Doubt(common_ln=0.01, tilt=0.0, floor=0.001, floor_own=0.001)
    survey = survey_of(lamps, 0.016 if solver is Solver.ML else 0.0)
    ratios = []
    for _ in range(250):
        xy = rng.uniform(2.5, 7.5, 2)
        received = perturbed(receive(survey, xy), survey, doubt, rng)
        place = locate(received, survey, SolverSettings(solver, link_n, doubt=doubt)).places[0]
        off = place.xy - xy
        ratios.append(off @ np.linalg.solve(place.covariance, off))
    assert 1.5 < np.mean(ratios) < 2.6


def test_chi2_tells_a_bad_link() -> None:
    survey = survey_of(PAPER, 0.016)
    received = receive(survey, (5.0, 4.0))
    good = locate(received, survey, SolverSettings(link_n=None)).places[0]
    assert good.chi2 < 0.01
    assert good.freedom == len(received.lamps) - 2
    received.amplitude[int(np.argmax(received.amplitude))] *= 0.6
    assert locate(received, survey, SolverSettings(link_n=None)).places[0].chi2 > 20.0


def test_shortest_links_first_and_none_from_beyond_the_rim() -> None:
    survey = survey_of(PAPER, 0.016)
    e = expected(PAPER, survey, np.array((5.0, 4.0, 0.0)))
    received = Received(PAPER, e.amplitude, np.full(16, 1e-18))
    order = shortest(received, survey)
    assert np.all(np.diff(e.amplitude[list(order)]) <= 0.0)
    assert len(order) == 16
    within = shortest(received, survey, 0.6)
    assert set(within) == set(np.flatnonzero(e.direct > 0.0).tolist())
    strong = tuple(replace(lamp, power_w=9.0) if lamp.lamp_id == 0 else lamp for lamp in PAPER)
    e = expected(strong, survey, np.array((5.0, 4.0, 0.0)))
    assert shortest(Received(strong, e.amplitude, np.full(16, 1e-18)), survey)[0] != 0  # shortest, not brightest


def test_without_floor_undoes_a_known_floor() -> None:
    survey, bare = survey_of(PAPER, 0.016), survey_of(PAPER)
    received, clean = receive(survey, (4.0, 4.5)), receive(bare, (4.0, 4.5))
    np.testing.assert_allclose(without_floor(received, survey).amplitude, clean.amplitude, rtol=1e-12)
    assert nearest(locate(received, survey, SolverSettings(Solver.LS)), (4.0, 4.5)) > 0.02
    assert nearest(locate(without_floor(received, survey), survey, SolverSettings(Solver.LS)), (4.0, 4.5)) < 1e-6


def count(received: Received, survey: Survey, method: SolverSettings) -> int:
    return len(adapted(usable(received, survey, method), survey, method))


def test_adaptive_number_fits_the_solver() -> None:
    """Far links spoil the plain solver (floor, error of d^2) and help the weighted one."""
    survey = survey_of(PAPER, 0.016)
    received = receive(survey, (5.0, 5.0))
    plain = count(received, survey, SolverSettings(Solver.LS, None))
    weighted = count(received, survey, SolverSettings(Solver.ML, None))
    assert 3 <= plain < weighted == len(shortest(received, survey, 0.6))
    assert count(received, survey, SolverSettings(Solver.ML, 5)) == 5
    assert len(locate(received, survey, SolverSettings(Solver.LS, None, adaptive=True)).used) == plain
    assert count(received.pick((0, 1)), survey, SolverSettings()) == 2


@pytest.mark.parametrize("blocked", range(4))
def test_adaptive_leaves_out_what_contradicts(blocked: int) -> None:
    """A lamp half hidden by a shelf, be it the nearest: without it the place is exact again."""
    survey = survey_of(PAPER, 0.016)
    received = receive(survey, (4.6, 5.3))
    hidden = shortest(received, survey)[blocked]
    received.amplitude[hidden] *= 0.4
    spoilt = locate(received, survey, SolverSettings(link_n=None))
    found = locate(received, survey, SolverSettings(link_n=None, adaptive=True))
    assert hidden not in found.used
    assert nearest(found, (4.6, 5.3)) < 0.02 < nearest(spoilt, (4.6, 5.3))
