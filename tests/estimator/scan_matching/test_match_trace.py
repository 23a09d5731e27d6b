"""What a match leaves behind: its trace and its evidence."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.match_entry import Entry, entry_of
from estimator.measurements import UNLIMITED, Array, Beam, Limits, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, State, new_state, step
from estimator.result import Fix, MatchResult, Reason
from estimator.scan_matching import icp, match_trace
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.local_map import MARGIN, SAMPLES, LocalMap, contradicted, look_at
from estimator.scan_matching.match_trace import Told
from estimator.scan_matching.scan_matcher import FEW, Asked, Attempt, MatchSettings, View, attempt, held, match
from tests.estimator.lit import lit_state, play, scans, together
from tests.estimator.scan_matching.test_icp import pair_of
from tests.estimator.test_pipeline import bad, drive, path, scan_at
from tests.estimator.world import map_of, points_in, prior_at, scan_in, view_of
from tools.bench.support.scenes import bearings, office, paper_room
from tools.sim.light.link_drive import room_run


def listen(state: State) -> list[Entry]:
    """Every match of this robot from now on."""
    heard: list[Entry] = []

    def told(scan: Scan, points: ScanPoints, asked: Asked | None, result: MatchResult) -> None:
        heard.append(entry_of(state, scan, points, asked, result))

    state.journal = told
    return heard


def holds(told: Told) -> None:
    """What is told of the pairs adds up to what the match itself has summed up at the time."""
    attempt = told.attempt
    assert len(told.iterations) == attempt.iterations
    for one in told.iterations:
        pairs, stride = one.pairs, one.row[icp.STRIDE]
        assert stride * len(pairs.point) == one.row[icp.PAIRED]
        assert stride * pairs.fits.sum() == one.row[icp.FITTED]
        np.testing.assert_allclose(pairs.weight.sum(), one.row[icp.WEIGHED], rtol=1e-9)
        np.testing.assert_allclose(pairs.square.sum(), one.row[icp.SQUARED], rtol=1e-9)
        assert (pairs.point % int(stride) == 0).all()
        assert np.abs(pairs.residual_m).max(initial=0.0) <= one.row[icp.GATE]
    np.testing.assert_allclose(told.iterations[0].T_odom_base, attempt.prior.T, atol=1e-12)


def entry_for(asked: Asked, result: MatchResult, scan: Scan) -> Entry:
    return Entry(scan, points_in(scan), asked, result, None)


def test_the_pairs_add_up_and_the_last_pose_is_the_result() -> None:
    rng = np.random.default_rng(2)
    local, view, T, T_new = pair_of(paper_room(), bearings(91, 180.0), 0.05, 2.0, rng)
    asked = (view, local, prior_at(T, 0.2, 0.1), 30, MatchSettings())
    result = match(*asked)
    (told,) = match_trace.tell(entry_for(asked, result, scan_in(paper_room(), T_new, bearings(91, 180.0), rng)).asked)
    assert told.what == "first"
    holds(told)
    assert result.ok
    np.testing.assert_array_equal(told.attempt.T[:2], result.T_odom_base[:2])  # to the last bit
    assert se2.wrap(told.attempt.T[2]) == result.T_odom_base[2]
    away = [np.hypot(*(one.T_odom_base - result.T_odom_base)[:2]) for one in told.iterations]
    assert away[-1] < 0.001 < away[0]
    last = told.iterations[-1]
    rows = local.elements[last.pairs.element]
    at = se2.apply(last.T_odom_base, view.points[last.pairs.point, :2])
    np.testing.assert_allclose(last.pairs.residual_m, (rows[:, 2:4] * (at - rows[:, :2])).sum(axis=1), atol=1e-12)


@pytest.mark.jit
@pytest.mark.parametrize("beams", [361, 1081])
def test_a_second_opinion_is_told_with_all_its_trials(beams: int) -> None:
    """From 60 deg away first attempts fail; 1081 beams are taken by fours while the pose is far off."""
    rng, bearing, found = np.random.default_rng(3), bearings(beams, 270.0), 0
    for _ in range(6):
        local, view, T, T_new = pair_of(office(), bearing, 0.1, 60.0, rng)
        asked = (view, local, prior_at(T, 0.2, 0.1), 50, MatchSettings())
        result = match(*asked)
        told = match_trace.tell(entry_for(asked, result, scan_in(office(), T_new, bearing, rng)).asked)
        names = [one.what for one in told]
        assert names[0] == "first"
        assert set(names[1:-1]) <= {"trial"}
        assert names[-1] in ("first", "trial", "final")
        for one in told:
            holds(one)
        strides = {row.row[icp.STRIDE] for one in told for row in one.iterations}
        assert strides <= ({1.0, 4.0} if beams > 400 else {1.0})
        if result.ok and names[-1] == "final":
            found += 1
            ends = [one.attempt.T[:2] for one in told if one.what != "trial"]
            assert any(np.array_equal(end, result.T_odom_base[:2]) for end in ends)
    assert found > 0


def test_matches_under_caps_are_told_as_they_were() -> None:
    state = new_state(Settings())
    heard = listen(state)
    noise = np.random.default_rng(1)
    for k, T in enumerate(path(40)[:4]):
        step(state, [scan_at(T, 0.05 * k, k, noise)], Limits(2, 60, True))
    assert [entry.result.reason for entry in heard][:1] == [Reason.NO_MAP]
    assert match_trace.tell(heard[0].asked) == ()
    for entry in heard[1:]:
        (told, *_) = match_trace.tell(entry.asked)
        assert len(told.iterations) <= 2
        assert told.attempt.points <= 60
        holds(told)


def test_who_listens_changes_nothing() -> None:
    alone, watched = new_state(Settings()), new_state(Settings())
    heard = listen(watched)
    _, one = drive(alone, odometry=True, n=8)
    _, two = drive(watched, odometry=True, n=8)
    assert len(heard) == 8
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)
        np.testing.assert_array_equal(a.covariance, b.covariance)
    for entry, result in zip(heard, two, strict=True):
        assert entry.result is result.match
        assert entry.light is None


def test_what_was_not_matched_is_told_too() -> None:
    state = new_state(Settings())
    heard = listen(state)
    drive(state, odometry=True, n=2)
    step(state, [bad("empty")], UNLIMITED)
    assert heard[-1].result.reason is Reason.TOO_FEW_POINTS
    assert heard[-1].asked is None
    assert match_trace.tell(heard[-1].asked) == ()


@pytest.mark.jit
def test_lamps_are_points_of_eq_13() -> None:
    """What light sees from two places and the laser's motion between them agree to what light is good for."""
    run = replace(room_run(seed=1, people=0), seconds=22.0)
    state = lit_state(run)
    heard = listen(state)
    play(state, together(run.odometry(), run.light(), scans(run)), run.truth)
    assert heard[0].light is not None
    assert heard[0].light.lamps == ()  # light has not found its place yet
    good = [entry.light for entry in heard[-30:] if entry.light is not None and entry.light.fix is Fix.GOOD]
    assert len(good) > 10
    lamps = [lamp for said in good for lamp in said.lamps if lamp.reference is not None and lamp.residual is not None]
    assert len(lamps) >= 4 * len(good)
    assert max(float(np.hypot(*lamp.residual)) for lamp in lamps if lamp.residual is not None) < 0.1
    moved = [float(np.hypot(*(lamp.present - lamp.reference))) for lamp in lamps if lamp.reference is not None]
    assert 0.05 < max(moved) < 1.5  # the robot turns and drives up to a keyframe's worth
    assert {lamp.lamp_id for lamp in lamps} <= {lamp.lamp_id for lamp in run.survey.lamps}


SETTINGS = MatchSettings()
NOISE = 0.01


def scene_of(beams: int, rng: np.random.Generator) -> tuple[LocalMap, View, Attempt]:
    """A map of two scans, a third, and where it was found."""
    scene = office() if beams > 200 else paper_room()
    T, bearing = scene.place(rng), bearings(beams, 200.0)
    seen = [(pose, scan_in(scene, pose, bearing, rng)) for pose in (T, T + np.array((0.05, 0.02, 0.3)))]
    local, view = map_of(seen), view_of(scan_in(scene, T, bearing, rng))
    return local, view, attempt(view, local, prior_at(T, 0.1, 0.1), 30, SETTINGS)


def said_of(points: Array, eye: Array, beams: tuple[Array, Array, np.ndarray]) -> np.ndarray:
    said = np.empty(len(points), np.int8)
    look_at(points, eye, beams, MARGIN + 5.0 * NOISE, 1, said)
    return said


@pytest.mark.parametrize("beams", [91, pytest.param(1081, marks=pytest.mark.jit)])
def test_evidence_is_elements_looked_through_and_points_that_hang_in_space(beams: int) -> None:
    rng = np.random.default_rng(beams)
    local, view, found = scene_of(beams, rng)
    eye = found.T + rng.normal(0.0, 0.2, 3)
    assert local.newest is not None
    said = said_of(np.ascontiguousarray(local.elements[:: max(1, len(local.elements) // SAMPLES)]), eye, view.beams)
    bearing, distance, kind = view.beams
    hit = np.flatnonzero(kind == Beam.HIT)
    hit = hit[:: max(1, len(hit) // SAMPLES)]
    ends = np.column_stack((distance[hit] * np.cos(bearing[hit]), distance[hit] * np.sin(bearing[hit])))
    points = np.hstack((se2.apply(eye, ends), np.zeros((len(hit), 2))))
    said = np.concatenate((said, said_of(points, local.newest.T_odom_lidar, local.newest.beams())))
    against, told = int((said < 0).sum()), int((said != 0).sum())
    assert told > len(said) // 4
    assert contradicted(local, eye, view.beams, NOISE) == pytest.approx(against / told, abs=1e-12)
    assert contradicted(local, found.T, view.beams, NOISE) < 0.05


@pytest.mark.parametrize("beams", [91, pytest.param(1081, marks=pytest.mark.jit)])
def test_what_is_held_is_the_least_share_of_surface_that_fits(beams: int) -> None:
    """By generalized eigenvalues over every point, paired afresh."""
    local, view, found = scene_of(beams, np.random.default_rng(beams))
    axis, scale = local.axis, SETTINGS.scale * NOISE
    assert held(found, local, SETTINGS) > 0.9
    found.T = found.T + np.array((0.06, -0.04, 0.01))
    T = found.T - np.array((*axis.centre, 0.0))
    seen, fitting = FEW * np.eye(2), FEW * np.eye(2)
    for x, y, tx, ty in view.points:
        p, t = se2.apply(T, np.array(((x, y),)))[0], se2.rotation(T[2])[:2, :2] @ (tx, ty)
        across = np.array((-t[1], t[0]))
        seen += np.outer(across, across)
        d = np.hypot(*(axis.rows[:, :2] - p).T)
        n = local.lines[int(d.argmin()), :2]
        off = abs(n @ (p - axis.rows[int(d.argmin()), :2]))
        if d.min() < max(6.0 * scale, 0.1) and off < 2.0 * scale and abs(n @ t) < icp.ASKEW:
            fitting += np.outer(across, across)
    least = np.linalg.eigvals(np.linalg.solve(seen, fitting)).real.min()
    assert least < 0.9
    assert held(found, local, SETTINGS) == pytest.approx(least, abs=1e-9)
    found.H = np.diag((0.0, 1e6, 1e6))
    assert held(found, local, SETTINGS) == pytest.approx(fitting[1, 1] / seen[1, 1], abs=1e-9)
    found.H = np.diag((1e6, 0.0, 1e6))
    assert held(found, local, SETTINGS) == pytest.approx(fitting[0, 0] / seen[0, 0], abs=1e-9)
    found.H = np.diag((0.0, 0.0, 1e6))
    assert held(found, local, SETTINGS) == 1.0
