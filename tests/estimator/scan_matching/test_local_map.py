"""The local map on simulated drives: bounded, rid of people, not led by glass; keyframes; what is learned of beams."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion.pose_update import loose_direction, updated
from estimator.mapping.keyframe import keep
from estimator.measurements import UNLIMITED, Beam, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, new_state, step
from estimator.result import Reason
from estimator.scan_matching import local_map
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.local_map import MapSettings
from estimator.scan_matching.residual_correlation import agreement, beams_each
from tests.estimator.driven import Driven, drive, records
from tests.estimator.test_pipeline import path, scan_at
from tests.estimator.world import map_of, points_in, scan_in, view_of
from tools.bench.support.scenes import Scene, bearings, box, paper_room
from tools.sim.building.buildings import corridor_loop
from tools.sim.scene import Scenario, SimulatedScene


@pytest.fixture(scope="module")
def two_rounds() -> Driven:
    """One round and a half of a corridor around a block, 200 m, people in it."""
    return drive(Scenario(lidar="UST-20LX", people=True, dwell_s=0.0), 330.0, 3.0, place=corridor_loop(people=3))


@pytest.mark.jit
def test_work_and_memory_do_not_grow_with_the_way(two_rounds: Driven) -> None:
    """Pairs looked at, elements and keyframes are those of the place, at the end as at the beginning."""
    work = np.array([r.match.iterations * r.match.queries for r in two_rounds.results[1:] if r.match is not None])
    thirds = np.array_split(work, 3)
    assert np.ptp(two_rounds.truth[:, 0]) > 20.0
    assert thirds[2].mean() < 1.3 * thirds[0].mean()
    state = two_rounds.state
    assert state.matching.local_map is not None
    assert len(state.matching.local_map.elements) <= Settings().map.capacity
    places = {(round(2 * x), round(2 * y)) for x, y, _ in two_rounds.truth}
    assert len(state.map.keyframes) <= 3 * Settings().keep * len(places)
    assert state.map.next_key > 1.1 * len(state.map.keyframes)  # some were let go for later ones


@pytest.mark.jit
def test_matches_hold_while_people_walk_by(two_rounds: Driven) -> None:
    failed = [r for r in two_rounds.results[1:] if r.match is None or not r.match.ok]
    assert len(failed) <= 0.01 * len(two_rounds.results)
    assert np.percentile(two_rounds.step_error_m, 99) < 0.03
    assert two_rounds.state.matching.restarts == 0


def ghosts(driven: Driven, scene: SimulatedScene) -> float:
    """Share of the map's elements that stand where nothing of the building is."""
    assert driven.state.matching.local_map is not None
    start = scene.truth(driven.t[:1])[0]
    T_site_odom = se2.compose(start, se2.inverse(driven.results[0].T_odom_base))
    xy = se2.apply(T_site_odom, driven.state.matching.local_map.elements[:, :2])
    return float((scene.building.world.clearance(xy) > 0.15).mean())


def replayed(scene: SimulatedScene, log: list[tuple[float, list[Record]]], settings: Settings) -> Driven:
    state = new_state(settings)
    results = [step(state, found, UNLIMITED) for _, found in log]
    t = np.array([end for end, _ in log])
    site = scene.truth(t)
    truth = np.array([se2.compose(results[0].T_odom_base, se2.between(site[0], pose)) for pose in site])
    return Driven(t, truth, results, state)


@pytest.fixture(scope="module")
def glazed() -> tuple[SimulatedScene, list[tuple[float, list[Record]]]]:
    """45 s in the paper's room: two people walk there, one side is of glass."""
    scene = SimulatedScene(Scenario(seed=5))
    return scene, list(records(scene, 45.0, 8.0, True))


@pytest.mark.jit
def test_people_leave_the_map_and_glass_leads_nobody(
    glazed: tuple[SimulatedScene, list[tuple[float, list[Record]]]],
) -> None:
    scene, log = glazed
    driven = replayed(scene, log, Settings())
    assert all(r.match is not None and r.match.ok for r in driven.results[1:])
    assert driven.error_m.max() < 0.05
    share = ghosts(driven, scene)
    assert share < 0.02
    blind = Settings(map=replace(MapSettings(), strikes=1e9))
    assert ghosts(replayed(scene, log, blind), scene) > 2.0 * share  # what is looked through has to go


@pytest.mark.jit
def test_a_hairs_breadth_does_not_choose_other_keyframes(
    glazed: tuple[SimulatedScene, list[tuple[float, list[Record]]]],
) -> None:
    """A micrometre of noise on every wheel increment: the same scans are kept, and the pose ends within millimetres."""
    scene, log = glazed
    rng = np.random.default_rng(0)

    def shaken(record: Record) -> Record:
        return (
            replace(record, delta=record.delta + rng.normal(0.0, 1e-6, 3)) if isinstance(record, Odometry) else record
        )

    a = replayed(scene, log, Settings())
    b = replayed(scene, [(end, [shaken(r) for r in found]) for end, found in log], Settings())
    assert [r.keyframe >= 0 for r in a.results] == [r.keyframe >= 0 for r in b.results]
    assert np.hypot(*se2.between(a.results[-1].T_odom_base, b.results[-1].T_odom_base)[:2]) < 5e-3


@pytest.mark.jit
def test_a_robot_at_rest_lays_no_keyframes() -> None:
    state, noise = new_state(), np.random.default_rng(3)
    for k in range(200):
        step(state, [scan_at(np.zeros(3), 0.05 * k, k, noise)], UNLIMITED)
    assert state.map.next_key == 2


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_how_alike_neighbouring_beams_err_is_found(rho: float) -> None:
    """Noise that is a first-order autoregression over the beams, against a map without noise."""
    rng, scene, bearing = np.random.default_rng(6), paper_room(), bearings(361, 180.0)
    local = map_of([(np.zeros(3), scan_in(scene, np.zeros(3), bearing, None))])
    sums = np.zeros(3)
    for _ in range(12):
        scan = scan_in(scene, np.zeros(3), bearing, None)
        noise = rng.normal(0.0, 0.01, len(bearing))
        for i in range(1, len(noise)):
            noise[i] = rho * noise[i - 1] + np.sqrt(1.0 - rho * rho) * noise[i]
        shifted = replace(scan, range_m=scan.range_m + noise)
        sums += agreement(view_of(shifted).points, local.axis, local.lines, np.zeros(3), 0.05)
    assert sums[2] > 3000
    assert beams_each(sums[0], sums[1]) == pytest.approx((1.0 + rho) / (1.0 - rho), rel=0.25)


def test_without_residuals_beams_are_independent() -> None:
    assert beams_each(0.0, 0.0) == 1.0
    assert beams_each(-1.0, 2.0) == 1.0
    assert beams_each(2.0, 2.0) == pytest.approx(19.0)


def test_what_a_match_does_not_hold_gets_no_surer_with_wheels() -> None:
    """A corridor whose direction trembles by a tenth of a degree, 400 scans: nothing adds up along it."""
    rng = np.random.default_rng(2)
    P = np.diag((0.04, 0.04, 0.01))
    for _ in range(400):
        a = 0.5 * np.pi + rng.normal(0.0, 2e-3)
        n = np.array((np.cos(a), np.sin(a), 0.0))
        P = updated(P, 1e7 * np.outer(n, n) + np.diag((0.0, 0.0, 1e6)), True)
    assert np.sqrt(P[0, 0]) > 0.19
    assert np.sqrt(P[1, 1]) < 0.002
    assert loose_direction(np.diag((1e6, 1e6, 1e6))) is None


@pytest.mark.jit
def test_along_a_corridor_a_guess_is_stated_as_one() -> None:
    """Without wheels the velocity carries the robot on, unseen: 10 s later its place along the axis is worth metres."""
    scene = Scene(np.array(box(-60, -1, 60, 1), dtype=np.float64), (-10, -0.5), (10, 0.5))
    state, rng, bearing = new_state(), np.random.default_rng(1), bearings(361, 180.0)
    for k in range(100):
        whole = scan_in(scene, np.array((0.05 * k, 0.0, 0.0)), bearing, rng, t=0.1 * k)
        near = np.where(whole.range_m < 12.0, whole.beam, np.uint8(Beam.NONE)).astype(np.uint8)  # the ends are not seen
        result = step(state, [replace(whole, beam=near)], UNLIMITED)
    along, across = np.sqrt(np.diag(result.covariance))[:2]
    assert along > 3.0
    assert across < 0.05


def test_a_surface_is_never_straighter_than_walls_are() -> None:
    local = map_of([(np.zeros(3), scan_in(paper_room(), np.zeros(3), bearings(361, 180.0), None))])
    assert local.lines[:, 2].min() >= local_map.WAVY**2


@pytest.mark.jit
def test_a_map_begun_anew_is_told_and_wheels_give_it_a_second() -> None:
    """The robot is carried elsewhere: nothing fits; after a second a new map is begun, and counted."""
    state, noise, t = new_state(), np.random.default_rng(4), 0.0
    truth = path(60)
    for k, T in enumerate(truth):
        moved = Odometry(t - 0.05, t, se2.between(truth[max(k - 1, 0)], T))
        result = step(state, [moved, scan_at(T, t, k, noise)], UNLIMITED)
        t += 0.05
    assert result.anew == 0
    scene, bearing = Scene(np.array(box(-2, -9, 1, 1), dtype=np.float64), (-1, -1), (1, 1)), bearings(541, 270.0)
    begun = []
    for _ in range(60):
        scan = scan_in(scene, np.array((0.0, 0.0, 0.7)), bearing, noise, t=t)
        result = step(state, [Odometry(t - 0.05, t, np.zeros(3)), scan], UNLIMITED)
        begun.append(result.anew)
        t += 0.05
    assert begun[15] == 0
    assert begun[-1] == 1
    assert result.match is not None
    assert result.match.ok


def test_who_sees_nothing_contradicts_nothing() -> None:
    """A covered lidar does not use up the patience: its map is still there when the cover is taken away."""
    state, noise = new_state(), np.random.default_rng(5)
    for k in range(10):
        step(state, [scan_at(np.zeros(3), 0.05 * k, k, noise)], UNLIMITED)
    local, blind = state.matching.local_map, np.zeros(541, np.uint8)
    for k in range(10, 20):
        covered = replace(scan_at(np.zeros(3), 0.05 * k, k, noise), beam=blind)
        result = step(state, [covered], UNLIMITED)
        assert result.match is not None
        assert result.match.reason is Reason.TOO_FEW_POINTS
    result = step(state, [scan_at(np.zeros(3), 1.0, 20, noise)], UNLIMITED)
    assert result.match is not None
    assert result.match.ok
    assert state.matching.local_map is local
    assert result.anew == 0


def test_lines_of_a_keyframe_that_hang_in_free_space_are_left_out() -> None:
    """Who has just walked in stands where the keyframe before looked through: not taken into the map."""
    scene, rng, bearing = paper_room(), np.random.default_rng(7), bearings(361, 180.0)
    first = scan_in(scene, np.zeros(3), bearing, rng)
    reach = first.range_m.copy()
    reach[170:190] = 1.5  # a person, 1.5 m ahead
    second = Scan(0.1, 0.1, 1, np.zeros(3), bearing, reach, first.beam, 0.01)
    before, after = (keep(k, np.zeros(3), np.zeros(3), scan, 0.0) for k, scan in enumerate((first, second)))
    lines = lines_of(points_in(second))
    person = np.hypot(lines[:, 0], lines[:, 1]) < 1.8
    kept = local_map.standing(after, lines, before, local_map.MARGIN + 0.05)
    assert person.sum() > 1
    assert (np.hypot(kept[:, 0], kept[:, 1]) < 1.8).sum() == 0
    assert len(kept) > 0.95 * (len(lines) - person.sum())
