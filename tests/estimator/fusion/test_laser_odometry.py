"""Without wheels the `lights` filter hears from the laser how the robot moves, and never where it is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

from estimator.fusion import laser_odometry
from estimator.light_filter import collinear_lamps, light_filter, motion_update, state_vector
from estimator.light_filter.collinear_lamps import LASTING_S
from estimator.light_filter.gain_memory import sensors_known
from estimator.light_filter.light_channel import LightChannel
from estimator.light_filter.light_filter import HELD_S
from estimator.light_filter.motion_update import prior_scales
from estimator.measurements import Array, Imu, Odometry, Record
from estimator.numerics import se2
from estimator.pipeline import in_turn
from estimator.result import Fix, MatchResult, Reason
from estimator.scan_matching.scan_matcher import no_match
from tests.estimator.light_room import SURVEY, Room, circle
from tests.estimator.lit import lit_state, play, scans, together
from tools.sim.light.link_drive import LightRun, room_run

pytestmark = [pytest.mark.jit, pytest.mark.no_cover]

FRAME = np.array((3.0, -2.0, 1.0))
"""Where the frame of the matches begins: nobody may take it for the survey's."""


def matched(t: float) -> Array:
    return se2.compose(FRAME, se2.compose(se2.inverse(circle(0.0)), circle(t)))


def led(move: bool, seconds: float = 25.0) -> tuple[light_filter.Lights, float, float]:
    """A filter after a round drive, with the medians of its errors (m, rad) since 10 s."""
    filter_, errors = light_filter.new_lights(SURVEY), []
    for k in range(1, round(10.0 * seconds) + 1):
        t = 0.1 * k
        result = light_filter.update(filter_, Room(seed=k).epoch(t - 0.03, circle(t - 0.03)))
        if move:
            made = se2.between(matched(t - 0.1), matched(t))
            light_filter.move(filter_, Odometry(t - 0.1, t, made), se2.log(made) / 0.1)
        off = result.T_map_base - circle(result.t_pose)
        errors.append((math.hypot(off[0], off[1]), abs(se2.wrap(float(off[2])))))
    assert result.fix is Fix.GOOD
    metres, radians = np.median(errors[100:], axis=0).tolist()
    return filter_, metres, radians


def placed(T: Array) -> light_filter.Lights:
    """A filter that has just been told where it is."""
    filter_ = light_filter.new_lights(SURVEY)
    light_filter.place(filter_, T, np.diag((0.01, 0.01, 0.01)))
    light_filter.carry_to(filter_, 0.0)
    return filter_


def test_what_matches_say_of_way_and_turn_is_as_good_as_wheels() -> None:
    _, alone_m, alone_rad = led(False)
    moved, moved_m, moved_rad = led(True)
    assert alone_rad > math.radians(2.0)
    assert moved_rad < math.radians(1.0)
    assert moved_m < 0.6 * alone_m
    assert moved.course.wheels


def told(
    filter_: light_filter.Lights, begin: float, end: float, way: tuple[float, float, float], by_laser: bool
) -> None:
    """An increment by wheels, or by matches."""
    velocity = np.array(way) / (end - begin) if by_laser else None
    motion_update.on_odometry(filter_, Odometry(begin, end, np.array(way)), velocity)


@pytest.mark.parametrize("by_laser", [False, True])
@pytest.mark.parametrize("late_s", [0.0, 0.04, 0.09])
def test_a_way_that_is_told_late_is_carried_on_to_where_light_has_carried_it(late_s: float, by_laser: bool) -> None:
    """Epochs come between a scan's end and its match; else each such scan sets the robot back by what lies between."""
    filter_ = placed(np.array((5.0, 5.0, 0.0)))
    x = filter_.tracks[0].x
    told(filter_, -0.1, 0.0, (0.1, 0.0, 0.0), by_laser)
    began = 5.0 + 0.1 * (not by_laser) - float(x[0])
    for k in range(1, 6):
        light_filter.carry_to(filter_, 0.1 * k + late_s)
        told(filter_, 0.1 * k - 0.1, 0.1 * k, (0.1, 0.0, 0.0), by_laser)
    assert filter_.course.t_mono == pytest.approx(0.5 + late_s)
    assert x[0] + began - 5.0 - 0.1 * (not by_laser) == pytest.approx(0.5 + late_s, abs=1e-6)
    told(filter_, 0.5, 0.6, (0.1, 0.0, 0.0), by_laser)
    told(filter_, 0.6, 0.7, (0.0, 0.0, 0.0), by_laser)
    assert x[0] + began - 5.0 - 0.1 * (not by_laser) == pytest.approx(0.6, abs=1e-6), "stopped"


@pytest.mark.parametrize("late_s", [0.03, 0.09])
def test_what_begins_late_takes_back_what_was_guessed_beyond_it(late_s: float) -> None:
    """Else each time that the laser holds all axes again the robot is carried on by the same stretch twice."""
    filter_ = placed(np.array((5.0, 5.0, 0.0)))
    for turn in range(5):
        for k in range(1, 5):
            t = turn + 0.1 * k
            light_filter.carry_to(filter_, t + late_s)
            if k > 1:
                told(filter_, t - 0.1, t, (0.05, 0.0, 0.0), by_laser=True)
        light_filter.left_alone(filter_)
        light_filter.carry_to(filter_, turn + 0.7)
        light_filter.carry_to(filter_, turn + 1.0)
    assert filter_.tracks[0].x[0] - 5.0 == pytest.approx(0.5 * (5.0 - 0.2), abs=1e-6), "of the first it knew nothing"


@pytest.mark.parametrize("by_laser", [False, True])
@pytest.mark.parametrize("late_s", [0.0, 0.02, 0.05])
def test_a_turn_by_gyro_is_taken_once_however_late_the_wheels_are(late_s: float, by_laser: bool) -> None:
    filter_ = placed(np.array((5.0, 5.0, 0.0)))
    done = 0
    for k in range(1, 201):
        t = 0.01 * k
        light_filter.predict(filter_, Imu(t - 0.01, t, 0.01))
        while 0.1 * (done + 1) + late_s <= t + 1e-9:
            told(filter_, 0.1 * done, 0.1 * done + 0.1, (0.0, 0.0, 0.1), by_laser)
            done += 1
    assert filter_.tracks[0].x[2] == pytest.approx(2.0, abs=0.002)


def test_the_noise_of_the_way_does_not_depend_on_when_light_comes() -> None:
    spreads = []
    for late_s in (-0.1, -0.05, -0.01, 0.0, 0.03):
        filter_ = placed(np.array((5.0, 5.0, 0.0)))
        filter_.tracks[0].P[:3, :3] = 0.0
        told(filter_, -0.1, 0.0, (0.05, 0.0, 0.0), by_laser=True)
        for k in range(1, 201):
            if late_s > -0.1:
                light_filter.carry_to(filter_, 0.1 * k + late_s)
            told(filter_, 0.1 * k - 0.1, 0.1 * k, (0.05, 0.0, 0.0), by_laser=True)
        spreads.append(math.sqrt(filter_.tracks[0].P[2, 2]))
    wander = filter_.settings.motion.wander * math.sqrt(10.0)
    curve = filter_.settings.motion.curve * 10.0
    assert spreads == pytest.approx([math.hypot(wander, curve)] * 5, rel=0.03)


def test_left_alone_it_guesses_at_its_speed_at_once() -> None:
    """Coasting with hardly any noise it would be sure of a place that it has passed, or not come to."""
    filter_ = placed(np.array((5.0, 5.0, 0.0)))
    for k in range(1, 4):
        told(filter_, 0.1 * k - 0.1, 0.1 * k, (0.05, 0.0, 0.0), by_laser=True)
    light_filter.left_alone(filter_)
    track = filter_.tracks[0]
    assert not filter_.course.wheels
    assert track.x[state_vector.SPEED] == pytest.approx(0.5)
    before = float(track.P[0, 0])
    light_filter.carry_to(filter_, 0.7)
    assert track.P[0, 0] - before > 0.08**2
    told(filter_, 0.7, 0.8, (0.05, 0.0, 0.0), by_laser=False)
    light_filter.left_alone(filter_)
    assert filter_.course.wheels, "wheels of its own go on telling"


def test_a_robot_that_the_laser_saw_reverse_is_not_turned_round_for_it() -> None:
    filter_ = placed(np.array((5.0, 5.0, 0.0)))
    for k in range(1, 4):
        told(filter_, 0.1 * k - 0.1, 0.1 * k, (-0.06, 0.0, 0.0), by_laser=True)
    light_filter.left_alone(filter_)
    for t, turned in ((1.0, False), (3.0, True)):
        light_filter.carry_to(filter_, t)
        filter_.tracks[0].x[state_vector.SPEED], filter_.tracks[0].P[state_vector.SPEED, state_vector.SPEED] = (
            -0.6,
            0.01,
        )
        motion_update.face_forward(filter_, filter_.tracks[0])
        assert bool(abs(filter_.tracks[0].x[2]) > 3.0) is turned


def test_under_a_row_of_lamps_nothing_is_taken() -> None:
    filter_ = placed(np.array((5.0, 5.0, 0.5)))
    filter_.t_used = 0.0
    for k in range(1, 31):
        filter_.under.take(0.0, 1.0, filter_.course.T[:2], np.eye(3))
        filter_.t_used = min(0.1 * k, 2.0)  # then they go out
        light_filter.move(
            filter_, Odometry(0.1 * k - 0.1, 0.1 * k, np.array((0.1, 0.0, 0.0))), np.array((1.0, 0.0, 0.0))
        )
        assert filter_.course.wheels is (k < 10.0 * LASTING_S or k >= 20 + 10.0 * HELD_S)


@pytest.mark.parametrize("speed", [0.05, 0.5])
def test_who_turns_on_the_spot_under_a_row_of_lamps_goes_on_being_told(speed: float) -> None:
    """It knows the place by the lamps before; a lamp that is hidden would be taken for one across the row."""
    filter_ = placed(np.array((5.0, 5.0, 0.5)))

    def goes(k: int, step: tuple[float, float, float]) -> None:
        filter_.under.take(0.0, 1.0, filter_.course.T[:2], np.eye(3))
        filter_.t_used = 0.1 * k
        light_filter.move(filter_, Odometry(0.1 * k - 0.1, 0.1 * k, np.array(step)), 10.0 * np.array(step))

    for k in range(1, 31):
        goes(k, (0.002 * (-1) ** k, 0.0, 0.09))
        assert filter_.course.wheels
    assert filter_.tracks[0].x[2] == pytest.approx(0.5 + 30 * 0.09 - math.tau, abs=0.05)
    for k in range(31, 31 + round(2.0 / speed)):  # and drives on, however slowly
        goes(k, (0.1 * speed, 0.0, 0.0))
    assert not filter_.course.wheels


class Told:
    """What a `Light` was told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.moves, self.alone = list[Odometry](), 0
        monkeypatch.setattr(LightChannel, "move", lambda _, record, _v: self.moves.append(record))
        monkeypatch.setattr(LightChannel, "left_alone", lambda _: self.leave())

    def leave(self) -> None:
        self.alone += 1


def scanned(axes: tuple[int, int, int] = (1, 1, 1), information: float = 1e6) -> MatchResult:
    known = np.array(axes, dtype=np.float64)
    found = no_match(np.zeros(3), 300, Reason.NO_MAP)
    return replace(found, reason=Reason.CONVERGED, information=np.diag(information * known), known_axes=known)


def test_the_way_is_told_where_every_axis_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    told, state = Told(monkeypatch), lit_state(room_run(seed=1, people=0))
    steps: list[Any] = [
        (scanned(), 0.1, 0.05, 0, 0),
        (scanned(), 0.2, 0.10, 1, 0),
        (scanned((1, 0, 1)), 0.3, 0.15, 1, 1),  # a corridor
        (scanned(), 0.4, 0.20, 1, 1),
        (scanned(), 0.5, 0.25, 2, 1),
        (no_match(np.zeros(3), 300, Reason.NO_MAP), 0.6, 0.30, 2, 2),
        (scanned((1, 1, 0)), 0.7, 0.35, 2, 3),  # a round room
        (scanned(), 0.8, 0.40, 2, 3),
        (no_match(np.zeros(3), 300, Reason.PASSED_OVER), 0.9, 0.45, 2, 3),  # there was no time for this scan
        (scanned(), 1.0, 0.50, 3, 3),
        (scanned(), 1.1, 2.50, 3, 4),  # nothing indoors drives so fast: it was carried
        (scanned(), 1.2, 2.55, 4, 4),
        (scanned(), 1.3, 2.60, 5, 4),
        (scanned(), 1.9, 2.90, 5, 5),  # so slow a lidar does not tell how it moved meanwhile
        (scanned(), 2.0, 2.95, 6, 5),
    ]
    for match, t, x, moves, alone in steps:
        state.motion.t_mono, state.motion.T_odom_base = t, np.array((x, 0.0, 0.3))
        laser_odometry.guide(state.light, state.motion, match)
        assert (len(told.moves), told.alone) == (moves, alone), t
    assert (told.moves[1].t_begin, told.moves[1].t_end) == (0.4, 0.5)
    assert told.moves[1].delta.tolist() == pytest.approx([0.05 * math.cos(0.3), -0.05 * math.sin(0.3), 0.0])
    assert (told.moves[2].t_begin, told.moves[2].t_end) == (0.8, 1.0)


@pytest.mark.parametrize(("speed", "spin"), [(0.0, 0.0), (0.0, 0.5), (0.5, 0.0)])
def test_the_noise_of_matches_is_no_way(speed: float, spin: float) -> None:
    """Forty times a second it would be one on which strengths seem to say something new of the heading."""
    state = lit_state(room_run(seed=1, people=0))
    assert state.light is not None
    rng, moving = np.random.default_rng(1), state.motion
    for k in range(400):
        t = 0.025 * k
        moving.T_odom_base = np.array((speed * t, 0.0, se2.wrap(spin * t))) + rng.normal(0.0, 0.0015, 3)
        moving.velocity = np.array((speed, 0.0, spin)) + rng.normal(0.0, 0.02, 3)  # as the fused filter has it
        moving.t_mono = t
        laser_odometry.guide(state.light, state.motion, scanned())
    course = state.light.filter.course
    assert course.way == pytest.approx(speed * 10.0, rel=0.05, abs=0.1)
    assert np.abs(course.velocity - (speed, 0.0, spin)).max() < 0.1, "a correction by a match is no speed"


def test_while_wheels_tell_the_way_the_laser_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    told, state = Told(monkeypatch), lit_state(room_run(seed=1, people=0))
    state.motion.t_odometry = 0.0
    for k in range(100):
        state.motion.t_mono = 0.1 * k
        state.motion.T_odom_base = np.array((0.01 * k, 0.0, 0.0))
        laser_odometry.guide(state.light, state.motion, scanned())
        assert bool(told.moves) is (k > 10.0 * laser_odometry.WHEELS_GONE_S), "these are gone"
    assert not told.alone


def blind_drive(seed: int) -> tuple[LightRun, Iterator[Record]]:
    run = replace(room_run(seed=seed, people=0), seconds=20.0)
    return run, together(run.light(), scans(run))


def test_without_wheels_the_pose_is_known_as_soon_as_with_them() -> None:
    """Without a guide one of these four drives ends before it is, and 6 deg off."""
    logs = []
    for seed in range(4, 8):
        run, records = blind_drive(seed)
        state = lit_state(run)
        logs.append(play(state, records, run.truth))
        assert state.light is not None
        assert state.light.has_motion
        assert not state.motion.odometry
        known = next(r.t_mono for r in logs[-1].results if r.placed and r.covariance[2, 2] < 0.04**2)
        assert known < 16.0, "rad, where TRACKING begins"
    for begin, metres, degrees in ((8.0, 0.25, 2.0), (12.0, 0.15, 1.5)):
        rmse = np.sqrt(np.mean(np.square([log.rmse(begin) for log in logs]), axis=0))
        assert rmse[0] < metres
        assert np.degrees(rmse[1]) < degrees
        assert np.mean([log.nees(begin) for log in logs]) < 6.0


def test_a_place_that_is_hardly_known_without_wheels_says_nothing_of_the_heading() -> None:
    P = np.array(((1.0, 0.0, 0.1), (0.0, 0.01, 0.0), (0.1, 0.0, 0.02)))
    for spread, kept in ((1.0, False), (0.1, True)):
        for A in collinear_lamps.straighten(spread * P, spread * P):
            assert bool(A[0, 2]) is bool(A[2, 0]) is kept
            assert A[2, 2] == spread * 0.02


def test_wheels_that_come_later_are_not_believed_as_matches_were() -> None:
    """Of their scale nothing is known; nor is it kept for the next run what lamps said of that of matches."""
    filter_, _, _ = led(True, 20.0)
    track = filter_.tracks[0]
    prior = prior_scales(filter_)
    assert track.P[state_vector.SCALE, state_vector.SCALE] < 0.5 * prior[0]
    kept = sensors_known(filter_)
    assert kept is not None
    assert kept[0][:3].tolist() == [0.0, 0.0, 0.0]
    assert kept[1][:3] == pytest.approx(prior)
    now = filter_.course.t_mono
    light_filter.predict(filter_, Odometry(now, now + 0.1, np.array((0.04, 0.0, 0.016))))
    assert track.x[state_vector.SCALE : state_vector.CURVE + 1].tolist() == [0.0, 0.0, 0.0]
    assert np.diag(track.P)[state_vector.SCALE : state_vector.CURVE + 1] == pytest.approx(prior)


def test_reset_and_a_given_place_forget_that_lamps_were_a_row() -> None:
    filter_ = light_filter.new_lights(SURVEY)
    for forget in (light_filter.reset, lambda one: light_filter.place(one, np.zeros(3), np.eye(3))):
        filter_.under.take(0.0, 1.0, np.zeros(2), np.eye(3))
        forget(filter_)
        assert filter_.under.t == math.inf


@pytest.mark.parametrize("guided", [True, False])
def test_where_matches_tell_the_way_an_epoch_waits_for_the_scan_of_its_time(guided: bool) -> None:
    """Nobody knows until then how the robot has moved; wheels, and a scan without lamps, are taken as they come."""
    run = replace(room_run(seed=1, people=0), seconds=1.0)
    state, (first, second) = lit_state(run), islice(scans(run), 1, 3)
    assert state.light is not None
    state.light.guided = (0.0, np.zeros(3)) if guided else None
    wheels = Odometry(first.t_end, second.t_begin, np.zeros(3))
    ends = (first.t_end - 0.01, second.t_end - 0.01, second.t_end + 0.01)
    early, between, late = [replace(next(run.light()), t_end=t) for t in ends]
    taken = in_turn(state, [late, second, wheels, early, between, first])
    expected = (
        [first, early, wheels, second, between, late] if guided else [early, first, wheels, between, second, late]
    )
    assert [id(record) for record in taken] == [id(record) for record in expected]
