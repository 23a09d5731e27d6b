"""A robot that is carried off and goes on fitting its map: where the surroundings repeat its place is not believed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from estimator.fusion import light_witness
from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import Array, Command, Order
from estimator.numerics import se2
from estimator.pipeline import new_state
from estimator.relocalisation import (
    global_scan_match,
    kidnap_detection,
    relocalisation,
    unaligned_map,
)
from estimator.relocalisation.global_scan_match import Fit, Looked, Verdict
from estimator.relocalisation.hypothesis_tracking import Question
from tests.estimator.adrift import Robot, furnished, way
from tools.bench.support.scenes import Scene, box

pytestmark = pytest.mark.jit

IMAGE = Scene(np.array(box(-3.0, -2.0, 3.0, 2.0), dtype=np.float64), (-2.5, -1.5), (2.5, 1.5))
"""Turned by half a turn it looks the same from everywhere."""
CUPBOARD = Scene(np.vstack((IMAGE.walls, np.array(box(2.2, 1.3, 3.0, 2.0)))), IMAGE.low, IMAGE.high)
"""But for one thing in a corner."""
ABOUT = ((-1.5, -1.0), (1.5, -1.0), (1.5, 1.0), (-1.5, 1.0), (-1.5, -1.0), (1.5, -1.0), (1.5, 0.5))
OTHER_END = np.array((0.0, 0.0, np.pi))
HALL = ((1.0, 6.0), (10.8, 6.0))
TOUR = (*HALL, (1.85, 6.0), (1.85, 1.5), (1.85, 6.0), (5.85, 6.0))


def driven(
    scene: Scene,
    corners: Iterable[tuple[float, float]],
    step_m: float = 0.08,
    young: bool = False,
    lights: LightsSetup | None = None,
) -> Robot:
    """A robot that was switched on at the first corner, has come to the last one, and knows its place.

    ``young``: nothing of its map is finished yet.
    """
    poses = way(tuple(corners), step_m)
    state = new_state(lights=lights)
    state.pose.T_map_odom = poses[0].copy()  # the map's frame is the building's
    robot = Robot(state, scene)
    said = [robot.at(T).places for T in poses]
    assert set(said) == {None}
    assert robot.off()[0] < 0.1
    assert bool(state.map.graph.settled()) is not young
    return robot


def stand(robot: Robot, T: Array, scans: int, covered: bool = False) -> list[int | None]:
    """What is said while the robot stands; the first scan may be from another place than the one before."""
    return [robot.at(T, carried=k == 0, covered=covered).places for k in range(scans)]


def test_put_down_near_the_other_end_of_a_room_that_is_its_own_image() -> None:
    """From one scan to the next: it fits there perfectly, but no wheel has moved the robot by that much."""
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((-0.7, 0.2, 0.3))))
    said = stand(robot, there, 20)
    assert None not in said[8:]
    x, y, yaw = there.tolist()
    ahead = (x + np.cos(yaw), y + np.sin(yaw))
    said = [robot.at(T).places for T in way(((x, y), ahead, (0.0, 0.0)), 0.06)]
    assert None not in said, "no way through that room tells its ends apart"
    assert said[-1] == 2


def test_put_down_close_to_the_image_of_its_place_while_the_lidar_was_covered() -> None:
    """No hand puts it there to the centimetre, and wheels that stand have not moved it by a foot."""
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((0.2, 0.1, 0.1))))
    stand(robot, there, 15, covered=True)
    said = stand(robot, there, 15)
    assert said[-1] is not None
    assert said[-1] == 2


def test_put_down_where_it_fits_to_a_hair_and_only_a_cupboard_is_missing() -> None:
    """No pose jumps, wheels and lidar tell nothing: what is seen has changed, from one scan to the next."""
    robot = driven(CUPBOARD, ABOUT)
    assert robot.T is not None
    said = stand(robot, se2.compose(OTHER_END, robot.T), 20)
    assert said[-1] is not None


def test_a_cupboard_that_is_carried_away_takes_nothing_from_a_place_that_is_like_no_other() -> None:
    """Not even if nobody was seen to do it: the place still holds, and there is no other."""
    plain = furnished()
    chest = Scene(np.vstack((plain.walls, np.array(box(6.6, 6.15, 7.4, 6.9)))), plain.low, plain.high)
    robot = driven(chest, TOUR)
    assert robot.T is not None
    asked = robot.state.relocalisation.suspicion.t_asked
    robot.scene = plain
    assert set(stand(robot, robot.T, 20)) == {None}
    assert robot.state.relocalisation.suspicion.t_asked > asked, "it has looked for itself"


def test_in_a_map_of_which_nothing_is_finished_a_jump_is_enough_and_a_covered_lidar_is_not() -> None:
    """There is nothing to be searched: what proves that it was carried counts, what only lets it be does not."""
    robot = driven(IMAGE, ABOUT[:2], young=True)
    assert robot.T is not None
    here = robot.T
    stand(robot, here, 15, covered=True)
    assert set(stand(robot, here, 10)) == {None}
    said = stand(robot, se2.compose(OTHER_END, se2.compose(here, np.array((0.6, 0.1, 0.2)))), 15)
    assert None not in said[6:]


@pytest.mark.parametrize("scans", [4, 15, 60])
def test_a_covered_lidar_takes_nothing_from_a_place_that_is_like_no_other(scans: int) -> None:
    robot = driven(furnished(), TOUR)
    assert robot.T is not None
    here = robot.T
    stand(robot, here, scans, covered=True)
    assert set(stand(robot, here, 20)) == {None}
    assert robot.state.relocalisation.suspicion.t_asked < 0.0, "it sees what it saw"
    laid = robot.state.map.next_key
    for T in way(((5.85, 6.0), (5.85, 1.5)), 0.08):
        assert robot.at(T).places is None
    assert robot.state.map.next_key > laid, "and the map goes on"
    assert robot.off()[0] < 0.1


@pytest.mark.parametrize("readings", [1, 10])
def test_wheels_that_turn_while_the_lidar_is_covered_say_that_nobody_carries_the_robot(readings: int) -> None:
    """However often they tell it: at 100 Hz 0.1 m/s is a millimetre a reading."""
    robot = driven(IMAGE, ABOUT)
    robot.readings = readings
    assert robot.T is not None
    poses = [se2.compose(robot.T, np.array((-0.01 * k, 0.0, 0.0))) for k in range(1, 36)]
    for T in poses[:25]:
        robot.at(T, covered=True)
    for T in poses[25:]:
        assert robot.at(T).places is None
        assert robot.state.relocalisation.suspicion.fitted == 0, "it was seen to drive"


def test_wheels_that_tell_nothing_do_not_say_that_the_robot_was_not_carried() -> None:
    """An emergency stop that takes the power from the wheels and their counters, and the lidar is covered."""
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((0.2, 0.1, 0.1))))
    for k in range(15):
        robot.at(there, carried=k == 0, covered=True, silent=True)
    said = [robot.at(there, silent=True).places for _ in range(3)] + stand(robot, there, 12)
    assert said[-1] == 2


def test_people_who_stand_about_and_leave_are_no_reason() -> None:
    """They hide walls, and take away nothing that many scans have proved."""
    plain = furnished()
    robot = driven(plain, TOUR)
    assert robot.T is not None
    for k in range(120):
        x, y = 5.0 + 0.02 * k, 6.45 - 0.1 * np.sin(0.2 * k)
        legs = np.array(box(x, y, x + 0.12, y + 0.12) + box(x + 0.3, y - 0.2, x + 0.42, y - 0.08), dtype=np.float64)
        robot.scene = Scene(np.vstack((plain.walls, legs)), plain.low, plain.high) if 20 < k < 100 else plain
        assert robot.at(robot.T).places is None
    assert robot.state.relocalisation.suspicion.t_asked < 0.0


def test_a_lidar_that_turns_once_a_second_is_no_covered_one() -> None:
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    state, here, asked = robot.state, robot.T, robot.state.relocalisation.suspicion.t_asked
    for _ in range(30):
        robot.t += 0.9
        robot.at(here)
    for _ in range(30):
        robot.t += 0.9
        assert robot.at(here).places is None
        assert state.relocalisation.suspicion.fitted == 0
    assert state.relocalisation.suspicion.t_asked == asked


def test_light_that_has_told_the_place_once_says_nothing_of_a_robot_that_is_carried_in_the_dark() -> None:
    robot = driven(IMAGE, ABOUT, lights=LightsSetup())
    tie = robot.state.pose.alignment
    assert tie is not None
    assert robot.T is not None
    tie.placed, tie.gap = True, 0.0  # the lamps went out then
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((-0.7, 0.2, 0.3))))
    assert stand(robot, there, 15)[-1] is not None


def test_a_reset_ends_every_suspicion() -> None:
    """There is no map any more that it would be of."""
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((-0.7, 0.2, 0.3))))
    robot.at(there, carried=True)
    assert robot.state.relocalisation.suspicion.jumped
    robot.at(there, Command(robot.t, Order.RESET))
    doubt = robot.state.relocalisation.suspicion
    assert (doubt.fitted, doubt.jumped, doubt.share, doubt.question) == (0, False, 0.0, None)
    assert set(stand(robot, there, 10)) == {None}
    assert robot.state.matching.restarts == 0


def test_a_map_of_one_scan_is_begun_anew_where_the_robot_was_put_down() -> None:
    """Nobody can be looked for in one scan; and no map may be of two places."""
    robot = Robot(new_state(), IMAGE)
    here = np.array((-1.5, -1.0, 0.0))
    stand(robot, here, 10)
    assert list(robot.state.map.keyframes) == [1]
    there = se2.compose(OTHER_END, se2.compose(here, np.array((0.6, 0.1, 0.2))))
    assert set(stand(robot, there, 10)) == {None}
    state = robot.state
    assert list(state.map.keyframes) == [2]
    assert [submap.first for submap in state.map.graph.submaps.values()] == [2]
    off = se2.between(state.map.T_map_start, se2.compose(state.pose.T_map_odom, state.motion.T_odom_base))
    assert np.abs(off).max() < 0.03, "it starts here"
    assert state.matching.restarts == 1


@pytest.mark.parametrize("covered", [False, True])
@pytest.mark.parametrize("most", [300, 1_000_000])
def test_a_search_that_had_to_be_ended_does_not_say_that_there_is_no_other_place(
    covered: bool, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search is repeated once with all nodes. Then the pose is neither given up nor confirmed."""
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    monkeypatch.setattr(kidnap_detection, "NODES", 300)
    monkeypatch.setattr(global_scan_match, "NODES", most)
    moved = (0.2, 0.1, 0.1) if covered else (-0.7, 0.2, 0.3)
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array(moved)))
    if covered:
        stand(robot, there, 15, covered=True)
    asked = robot.state.jobs.next_id
    stand(robot, there, 15)
    assert robot.state.map.parts.detached is not None
    assert robot.state.jobs.next_id - asked < 8, "it is not looked for again and again"


def test_nothing_is_laid_into_the_map_until_the_answer_has_come() -> None:
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    state, robot.late = robot.state, 8
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((0.2, 0.1, 0.1))))
    stand(robot, there, 15, covered=True)
    laid, places = state.map.next_key, None
    for k in range(1, 13):
        places = places or robot.at(se2.compose(there, np.array((-0.12 * k, 0.0, 0.0)))).places
        assert state.map.next_key == laid or places is not None
        assert (
            state.relocalisation.suspicion.fitted > 0
            or state.relocalisation.suspicion.question is not None
            or places is not None
        )
    assert places is not None


def test_an_answer_that_comes_late_counts_and_takes_what_was_laid_meanwhile_with_it() -> None:
    """Loops are searched for before it, and boards are slow; the map goes on after two seconds."""
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    state, robot.late = robot.state, 45
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((-0.7, 0.2, 0.3))))
    x, y, yaw = there.tolist()
    ahead = (x + np.cos(yaw), y + np.sin(yaw))
    before, most, begun = state.map.next_key, 0, [0]
    poses = way(((x, y), ahead, (0.0, 0.0), (1.0, 0.0), (-1.0, 0.5), (1.0, 0.5)), 0.08)
    robot.at(poses[0], carried=True)
    said = []
    for T in poses[1:]:
        said.append(robot.at(T).places)
        robot.late = 3 if said[-1] is not None else robot.late
        if said[-1] is None:
            most, begun = state.map.next_key, [submap.first for submap in state.map.graph.submaps.values()]
    assert most > before, "the map has gone on"
    assert before in begun, "in a submap of its own, or a part of it would stay in an older one"
    assert said[-1] is not None
    assert state.map.parts.detached_since >= most
    assert not [key for key in state.map.keyframes if before <= key < most], "or it would be found there again"
    assert all(submap.first < before or submap.first >= most for submap in state.map.graph.submaps.values())


def test_a_look_that_never_answers_is_made_again() -> None:
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((-0.7, 0.2, 0.3))))
    assert set(stand(robot, there, 5)) == {None}
    assert robot.state.relocalisation.suspicion.question is not None
    robot.due = []
    assert set(stand(robot, there, 90)) == {None}
    assert stand(robot, there, 25)[-1] is not None


def test_a_jump_while_a_look_is_under_way_is_not_forgotten() -> None:
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    doubt, asked = robot.state.relocalisation.suspicion, Question(False, True, False)
    doubt.question, doubt.t_asked = asked, robot.t
    there = se2.compose(OTHER_END, se2.compose(robot.T, np.array((-0.7, 0.2, 0.3))))
    assert set(stand(robot, there, 6)) == {None}
    fine = Fit(there, np.eye(3), 0.9, 0.0, 0.01, 1, np.zeros(3), Verdict.HOLDS)
    kidnap_detection.answered(robot.state, asked, Looked(None, (fine,), (), True, 0))  # type: ignore[arg-type]
    assert stand(robot, there, 10)[-1] is not None


@pytest.mark.parametrize(
    ("own", "share", "others", "complete", "carried"),
    [
        (Verdict.HOLDS, 0.9, (), True, False),
        (Verdict.NO, 0.9, (), True, False),  # a table between two scans; there is nowhere else to be
        (Verdict.NO, 0.9, (0.5,), True, True),  # though that fits with fewer beams than its own
        (Verdict.OPEN, 0.9, (0.5,), True, False),
        (Verdict.OPEN, 0.9, (0.8,), True, True),
        (Verdict.OPEN, 0.0, (0.0,), True, False),  # outside the finished map, and the other place fits no better
        (Verdict.HOLDS, 0.9, (), False, None),
    ],
)
def test_after_a_leap_it_is_adrift_where_another_place_fits(
    own: Verdict, share: float, others: tuple[float, ...], complete: bool, carried: bool | None
) -> None:
    """None: the search is repeated once; then odometry carries the pose, and the search goes on."""
    robot = driven(IMAGE, ABOUT)
    assert robot.T is not None
    state = robot.state
    said = Looked(
        None,  # type: ignore[arg-type]
        (Fit(robot.T, np.eye(3), share, 0.1, 0.01, 1, np.zeros(3), own),),
        tuple((Fit(OTHER_END, np.eye(3), other, 0.0, 0.01, 1, np.zeros(3), Verdict.OPEN), ()) for other in others),
        complete,
        0,
    )
    state.relocalisation.suspicion.question = asked = Question(False, True, False, True)
    kidnap_detection.answered(state, asked, said)
    assert (state.map.parts.detached is not None) is bool(carried)
    if carried is None:
        assert state.relocalisation.suspicion.fitted > 0
        assert state.relocalisation.suspicion.leapt
        state.relocalisation.suspicion.question = again = Question(False, True, True, True)
        kidnap_detection.answered(state, again, said)
        assert state.map.parts.detached is not None


def test_a_leap_in_a_map_of_which_nothing_is_finished_is_let_go() -> None:
    """There is nothing to be searched, and a leap proves nothing alone."""
    robot = driven(CUPBOARD, ABOUT[:2], young=True)
    assert robot.T is not None
    robot.scene = IMAGE
    assert set(stand(robot, robot.T, 20)) == {None}
    assert robot.state.relocalisation.suspicion.question is None
    assert not robot.state.relocalisation.suspicion.leapt


@pytest.mark.parametrize("since", [True, False])
def test_a_leap_while_light_told_the_place_is_judged_when_it_tells_no_more(
    since: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Put down where there are no lamps; those that are received afterwards (``since``) know better than any leap."""
    robot = driven(CUPBOARD, ABOUT)
    assert robot.T is not None
    here, lit, last = robot.T, [True], [robot.t]
    for user in (kidnap_detection, relocalisation, unaligned_map):
        monkeypatch.setattr(user, "light_holds", lambda *_: lit[0])
    monkeypatch.setattr(light_witness, "last_used", lambda _: last[0])
    there = se2.compose(OTHER_END, here)
    assert set(stand(robot, there, 10)) == {None}
    lit[0], last[0] = False, robot.t if since else last[0]
    assert (stand(robot, robot.T, 20)[-1] is None) is since
