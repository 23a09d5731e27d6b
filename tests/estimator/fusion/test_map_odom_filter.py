"""Light and laser in one step: where the map lies, who holds which axis, and what happens when one of them is gone."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from daemon.integrity.evidence import VAGUE_RAD
from estimator.fusion import light_witness
from estimator.light_filter.collinear_lamps import doubt
from estimator.measurements import UNLIMITED, Array, Command, LightEpoch, Odometry, Order, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import State, fuse_light, keyframe_poses, step
from estimator.result import SURPRISE, Fix
from tests.estimator.lit import Log, Truth, lights_at, lit_state, play, scans, together
from tools.sim.building.buildings import building
from tools.sim.ceiling.ceiling import ceiling_of
from tools.sim.ceiling.links import Reception
from tools.sim.ceiling.records import epochs, survey
from tools.sim.light.link_drive import LightRun, room_run
from tools.sim.robot.drive import Body, Drive, Route
from tools.sim.robot.odometry import Wheels

pytestmark = [pytest.mark.jit, pytest.mark.no_cover]


def room(seed: int, seconds: float) -> LightRun:
    return replace(room_run(seed=seed, people=0), seconds=seconds)


def corridor(seconds: float, seed: int = 4) -> LightRun:
    """Along the paper's corridor, whose lamps are 2.7 m apart."""
    place = building("paper_room")
    drive = Drive(Route(((-6.15, -3.0), (-6.15, 47.0)), 1.2), Body(), 0.0, 1)
    ceiling = ceiling_of(place, None, seed)
    return LightRun(drive, ceiling, survey(ceiling), Wheels(), place.world, seed, seconds, Reception())


def everything(run: LightRun) -> Iterator[Record]:
    return together(run.odometry(), run.light(), scans(run))


def without(records: Iterable[Record], kind: type, begin: float, end: float) -> Iterator[Record]:
    return (r for r in records if not (isinstance(r, kind) and begin <= r.t_end < end))


def longest_step(log: Log) -> float:
    """Of T_odom_base between two results, m."""
    poses = np.array([r.T_odom_base for r in log.results])
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).max())


@pytest.fixture(scope="module")
def driven() -> tuple[State, Log]:
    run = room(1, 45.0)
    state = lit_state(run)
    return state, play(state, everything(run), run.truth)


@pytest.fixture
def in_room(driven: tuple[State, Log]) -> Log:
    return driven[1]


def test_light_places_the_map_in_the_survey_and_the_laser_steadies_it(in_room: Log) -> None:
    before = [r for r in in_room.results if not r.placed]
    assert 0 < len(before) < 20
    assert all(np.array_equal(r.T_map_odom, np.zeros(3)) for r in before)
    metres, radians = in_room.rmse(30.0)
    assert metres < 0.08
    assert radians < np.radians(1.0)
    assert in_room.nees(20.0) < 9.0


@pytest.mark.slow
def test_eight_drives_are_as_good_and_as_honest_as_the_estimator_page_says() -> None:
    """With 12, of twenty the start that is led astray farthest: half a metre and more, with lamps bent by 13."""
    runs = [replace(room_run(seed=seed), seconds=110.0) for seed in (5, 6, 7, 8, 9, 10, 11, 12)]
    logs = [play(lit_state(run), everything(run), run.truth) for run in runs]
    for log in logs:
        found = log.after(10.0)
        heading, sigma = np.abs(np.array(log.error[found])[:, 2]), np.array([math.sqrt(P[2, 2]) for P in log.P[found]])
        assert np.degrees(heading[sigma < VAGUE_RAD].max()) < 5.0, "TRACKING could have been said"
    spans = ((10.0, 30.0, 0.14, 1.75), (30.0, 60.0, 0.06, 0.6), (60.0, 120.0, 0.05, 0.4))
    for begin, end, metres, degrees in spans:
        rmse = np.sqrt(np.mean(np.square([log.rmse(begin, end) for log in logs]), axis=0))
        assert rmse[0] < metres
        assert np.degrees(rmse[1]) < degrees
        assert 0.3 < np.mean([log.nees(begin, end) for log in logs]) < 5.0


def test_heading_is_unknown_until_the_robot_has_driven(in_room: Log) -> None:
    placed = next(r for r in in_room.results if r.placed)
    assert placed.covariance[2, 2] > 1.0
    assert placed.known_axes[2] == 0.0
    assert in_room.results[-1].known_axes.tolist() == [1.0, 1.0, 1.0]


def test_what_light_corrects_never_shows_in_the_odometry_frame(in_room: Log) -> None:
    assert in_room.results[-1].jumps > 0
    assert longest_step(in_room) < 0.1


def test_the_same_records_give_the_same_poses_to_the_last_bit() -> None:
    run = room(2, 6.0)
    first, second = (play(lit_state(run), everything(run), run.truth) for _ in range(2))
    for a, b in zip(first.results, second.results, strict=True):
        assert np.array_equal(a.T_map_odom, b.T_map_odom)
        assert np.array_equal(a.covariance, b.covariance)


def test_what_was_laid_before_the_place_was_known_comes_along() -> None:
    run = room(1, 20.0)
    state = lit_state(run)
    play(state, everything(run), run.truth)
    start = keyframe_poses(state)[1]
    error = start - run.truth(np.zeros(1))[0]
    assert np.hypot(*error[:2]) < 0.3
    assert abs(se2.wrap(error[2])) < np.radians(6.0)
    kept = next(reversed(state.map.keyframes.values())).virtual
    assert kept is not None
    assert kept.accepted


def test_the_laser_is_gone_for_a_while() -> None:
    run = room(1, 40.0)
    log = play(lit_state(run), without(everything(run), Scan, 20.0, 30.0), run.truth)
    assert log.rmse(20.5, 30.0)[0] < 0.15
    assert log.rmse(31.0)[0] < 0.2
    assert longest_step(log) < 0.1


@pytest.mark.slow
def test_light_is_gone_for_a_while_and_the_laser_carries_on() -> None:
    run = room(1, 40.0)
    log = play(lit_state(run), without(everything(run), LightEpoch, 20.0, 32.0), run.truth)
    dark = log.results[log.after(22.0, 32.0)]
    assert log.rmse(20.0, 32.0)[0] < 0.2
    assert np.linalg.det(dark[-1].covariance) > np.linalg.det(dark[0].covariance)  # what a lever swings keeps it
    assert log.rmse(36.0)[0] < 0.2


def kidnapped(run: LightRun, at: float) -> Truth:
    """Turned about the middle of the room, whose mirror image it is: the laser alone cannot tell."""
    turned = np.array((0.3, -0.2, np.pi))

    def truth(t: Array) -> Array:
        return np.array([se2.compose(turned, T) if s > at else T for s, T in zip(t, run.truth(t), strict=True)])

    return truth


def test_carried_to_where_the_room_looks_the_same() -> None:
    run = room(1, 38.0)
    truth = kidnapped(run, 22.0)
    light = epochs(run.ceiling, truth, (0.0, run.seconds), run.seed, run.reception)
    log = play(lit_state(run), together(run.odometry(), light, scans(run, truth)), truth)
    assert log.rmse(16.0, 22.0)[0] < 0.2
    assert log.rmse(23.0, 23.5)[0] > 1.0
    contradicted = [r for r in log.results[log.after(22.0, 27.0)] if r.gap is None or r.gap > SURPRISE]
    assert contradicted
    assert log.rmse(32.0)[0] < 0.3  # 3 m of way after light has found the place: then it is believed
    assert log.results[-1].jumps > log.results[log.after(21.9).start].jumps
    assert Fix.GOOD in log.fixes(29.0)


def contradict(state: State, fix: Fix) -> float:
    """Two seconds of light from two metres aside, sure or still looking; by how much the map moves, m."""
    assert state.light is not None
    told, before = state.light.result, state.pose.T_map_odom.copy()
    aside = replace(told, fix=fix, T_map_base=told.T_map_base + np.array((2.0, 0.0, 0.0)))
    for k in range(40):
        fuse_light(state, replace(aside, t_mono=told.t_mono + 0.05 * k))
    return float(np.hypot(*(state.pose.T_map_odom - before)[:2]))


def test_light_that_is_still_looking_does_not_move_a_proved_pose_unless_the_laser_is_blind() -> None:
    run = room(1, 14.0)
    sure, looking, dark = (lit_state(run) for _ in range(3))
    for state in (sure, looking, dark):
        log = play(state, everything(run), run.truth)
    assert log.fixes(13.0) == {Fix.GOOD}
    assert contradict(looking, Fix.STARTING) == 0.0
    assert contradict(sure, Fix.GOOD) == pytest.approx(2.0, abs=0.3)
    for k in range(10):
        step(dark, [Odometry(14.0 + 0.1 * k, 14.1 + 0.1 * k, np.zeros(3))], UNLIMITED)
    assert contradict(dark, Fix.STARTING) == pytest.approx(2.0, abs=0.3)


def test_a_heading_that_has_become_vague_makes_light_no_younger(driven: tuple[State, Log]) -> None:
    """Nor does a stretch between two lamps; only looking for the place does, because gains are not known then."""
    state = copy.deepcopy(driven[0])
    assert state.light is not None
    told, lights = state.light.result, state.light.filter
    turned = replace(told, fix=Fix.STARTING, covariance=np.diag((0.1**2, 0.1**2, 1.0)))
    assert not light_witness.restarting(state.light, told)
    assert not light_witness.restarting(state.light, replace(told, fix=Fix.HELD))
    assert not light_witness.restarting(state.light, turned)
    assert light_witness.restarting(state.light, replace(turned, covariance=np.diag((0.4**2, 0.1**2, 1.0))))
    for fix in (Fix.NONE, Fix.AMBIGUOUS, Fix.LOST):
        assert light_witness.restarting(state.light, replace(told, fix=fix))
    lights.lost = True
    assert light_witness.restarting(state.light, turned)
    lights.lost, lights.tracks = False, [*lights.tracks, *lights.tracks]
    assert light_witness.restarting(state.light, turned)


def test_a_first_start_that_was_wrong_is_mended_while_light_still_looks() -> None:
    run = room(1, 1.0)
    state = lit_state(run)
    log = play(state, everything(run), run.truth)
    assert Fix.GOOD not in log.fixes(0.0)
    assert state.pose.alignment is not None
    assert state.pose.alignment.placed
    state.pose.alignment.P = np.diag((0.1, 0.1, 0.05)) ** 2
    state.light.result = replace(state.light.result, covariance=np.diag((0.1, 0.1, 0.05)) ** 2)  # type: ignore[union-attr]  # it is lit
    assert contradict(state, Fix.STARTING) > 1.0


def test_a_corridor_takes_its_long_axis_from_light() -> None:
    run = corridor(30.0)
    log = play(lit_state(run), everything(run), run.truth)
    along = np.array(log.error)[log.after(10.0), 1]
    assert np.sqrt(np.mean(along**2)) < 0.05
    said = np.mean([r.known_axes for r in log.results[log.after(10.0)]], axis=0)
    assert said[1] == 1.0
    assert said[0] < 0.5  # one row of lamps does not tell left from right


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_all_along_a_corridor_the_long_axis_is_held_to_5_cm(seed: int) -> None:
    """Lamps of 5 % spread, 45 m one way; RMSE from ten seconds after power-on."""
    run = corridor(75.0, seed)
    log = play(lit_state(run), everything(run), run.truth)
    along = np.array(log.error)[log.after(10.0), 1]
    assert np.sqrt(np.mean(along**2)) < 0.05


@pytest.mark.slow
def test_light_and_odometry_alone_hold_the_pose_and_every_stretch_has_an_anchor() -> None:
    run = room(1, 30.0)
    state = lit_state(run)
    log = play(state, together(run.odometry(), run.light()), run.truth)
    assert log.rmse(15.0)[0] < 0.2
    assert log.results[-1].anchor > 10
    assert np.hypot(*log.results[-1].T_anchor_base[:2]) < 0.6
    assert state.map.keyframes == {}


def test_an_order_places_the_map_and_light_takes_it_from_there() -> None:
    run = room(1, 8.0)
    state = lit_state(run)
    true = run.truth(np.zeros(1))[0]
    step(state, [Command(0.0, Order.SET_POSE, se2.compose(true, np.array((0.1, -0.1, 0.05))))], UNLIMITED)
    log = play(state, everything(run), run.truth)
    assert all(r.placed for r in log.results)
    assert log.rmse(0.0)[0] < 0.35
    assert log.rmse(0.0)[1] < 0.3


def test_without_wheels_light_and_laser_find_the_heading_and_a_gap_of_the_laser_moves_nothing() -> None:
    runs = [room(seed, 36.0) for seed in (1, 2, 3)]
    logs = [
        play(lit_state(run), without(together(run.light(), scans(run)), Scan, 15.0, 28.0), run.truth) for run in runs
    ]
    for log in logs:
        assert log.rmse(10.0, 15.0)[1] < 0.15  # not the mirror image that reverses
        assert log.rmse(29.0)[0] < 0.3
        assert log.rmse(29.0)[1] < 0.15
    assert np.sqrt(np.mean([log.rmse(10.0, 15.0)[0] ** 2 for log in logs])) < 0.2


def test_reset_at_a_pose_after_a_blind_drive_leaves_an_honest_covariance() -> None:
    state = lit_state(room(1, 1.0))
    for k in range(1, 600):
        step(state, [Odometry(0.1 * (k - 1), 0.1 * k, np.array((0.05, 0.0, 0.01)))], UNLIMITED)
    result = step(state, [Command(60.0, Order.RESET, np.array((1.0, 2.0, 0.0)))], UNLIMITED)
    assert np.linalg.eigvalsh(result.covariance).min() > 0.0


def test_reset_forgets_where_the_map_lies() -> None:
    run = room(1, 3.0)
    state = lit_state(run)
    play(state, everything(run), run.truth)
    result = step(state, [Command(3.0, Order.RESET)], UNLIMITED)
    assert not result.placed
    assert result.gap is None


def test_with_nobody_to_tell_the_way_light_says_nothing_of_a_keyframes_heading(driven: tuple[State, Log]) -> None:
    """It may have settled the wrong way round, and the submap's origin is found from here by that heading."""
    state = copy.deepcopy(driven[0])
    assert state.light is not None
    T = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    state.motion.odometry = state.light.filter.course.wheels = False
    state.light.result = lights_at(T + np.array((0.02, -0.01, np.pi)), frozenset((1, 4, 13, 16)), state)
    told = light_witness.virtual(state.pose, state.motion, state.light)
    assert told is not None
    assert told.T_map_base == pytest.approx(T + np.array((0.02, -0.01, 0.0)), abs=1e-9)
    assert told.covariance[2, 2] > 3.0


def test_a_lamp_that_is_learned_anew_changes_what_its_row_does_not_tell(driven: tuple[State, Log]) -> None:
    catalogue = copy.deepcopy(driven[0].light.filter.catalogue)  # type: ignore[union-attr]  # lit
    row = frozenset((1, 2, 3))
    before = doubt(catalogue, row)
    assert before is doubt(catalogue, row)
    catalogue.add(replace(catalogue.by_id[2], y=catalogue.by_id[2].y + 3.0))
    assert doubt(catalogue, row)[1, 1] < 0.1 * before[1, 1]
    assert not doubt(catalogue, frozenset((998, 999))).any()


@pytest.mark.parametrize(("anew", "followed"), [(False, False), (True, True)])
def test_a_heading_from_light_is_followed_against_the_laser_only_if_light_has_looked_for_its_place_anew(
    driven: tuple[State, Log], anew: bool, followed: bool
) -> None:
    state = copy.deepcopy(driven[0])
    assert state.light is not None
    assert state.pose.alignment is not None
    T = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    told = T + np.array((0.0, 0.0, 1.0))
    if anew:
        state.light.filter.way_start = state.light.filter.course.way
    for _ in range(30):
        state.motion.t_mono += 0.05
        state.pose.alignment.t_match = state.motion.t_mono
        fuse_light(state, lights_at(told, frozenset((1, 4, 13, 16)), state))
    now = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    assert abs(se2.wrap(now[2] - T[2])) == pytest.approx(1.0 if followed else 0.0, abs=0.05)


@pytest.mark.parametrize(
    ("off", "broken", "lamps", "followed"),
    [
        ((0.9, 0.0), False, (1, 4, 13, 16), False),
        ((2.5, 0.0), False, (1, 4, 13, 16), True),
        ((0.9, 0.0), True, (1, 4, 13, 16), True),
        ((2.5, 0.0), False, (1, 16), False),  # two lamps do not check each other
        ((2.5, 0.0), True, (1, 16), True),
        ((1.0, 1.4), False, (1, 2, 3, 4), False),  # across their row they do not know, along it is not far
        ((2.5, 1.4), False, (1, 2, 3, 4), True),
    ],
)
def test_only_what_the_laser_could_have_lost_is_taken_from_light(
    driven: tuple[State, Log], off: tuple[float, float], broken: bool, lamps: tuple[int, ...], followed: bool
) -> None:
    state = copy.deepcopy(driven[0])
    tie = state.pose.alignment
    assert tie is not None
    assert tie.proved
    tie.broken = broken
    T = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    told = T + np.array((*off, 0.0))
    for _ in range(30):
        state.motion.t_mono += 0.05
        tie.t_match = state.motion.t_mono
        fuse_light(state, lights_at(told, frozenset(lamps), state))
    now = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    assert np.hypot(*(now - told)[:2]) < 0.05 if followed else np.hypot(*(now - T)[:2]) < 0.05


def test_one_lamp_beside_a_row_of_others_moves_nothing_until_it_has_been_there_for_a_while(
    driven: tuple[State, Log],
) -> None:
    """What a row has led astray becomes sure with the first lamp beside it, and is as wrong as before."""
    state = copy.deepcopy(driven[0])
    tie = state.pose.alignment
    assert tie is not None
    T = se2.compose(state.pose.T_map_odom, state.motion.T_odom_base)
    told = T + np.array((1.2, 1.6, 0.0))

    def moved(lamps: tuple[int, ...], times: int) -> float:
        for _ in range(times):
            state.motion.t_mono += 0.05
            tie.t_match = state.motion.t_mono
            fuse_light(state, lights_at(told, frozenset(lamps), state))
        return float(np.hypot(*(se2.compose(state.pose.T_map_odom, state.motion.T_odom_base) - T)[:2]))

    assert moved((1, 2, 3, 4), 30) < 0.05
    assert moved((1, 2, 3, 4, 13), 15) < 0.05
    assert moved((1, 2, 3, 4, 13), 15) == pytest.approx(2.0, abs=0.05)
