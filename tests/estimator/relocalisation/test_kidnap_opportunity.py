"""What a kidnapping needs: an opportunity, and evidence that neither people nor a thin scan explain."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.relocalisation import kidnap_detection, kidnap_opportunity, relocalisation
from estimator.relocalisation.global_scan_match import Fit, Looked, Verdict
from estimator.relocalisation.hypothesis_tracking import Question
from tests.estimator.relocalisation.test_kidnap_detection import ABOUT, CUPBOARD, OTHER_END, driven

pytestmark = pytest.mark.jit


@pytest.mark.parametrize("own", [Verdict.HOLDS, Verdict.OPEN])
@pytest.mark.parametrize("odd", [True, False])
def test_without_a_sign_of_motion_another_place_that_fits_is_no_reason_to_give_one_up(own: Verdict, odd: bool) -> None:
    """After a rest without data, odometry carries a pose that the map does not confirm; the search goes on."""
    robot = driven(CUPBOARD, ABOUT)
    assert robot.T is not None
    here = Fit(robot.T, np.eye(3), 0.7, 0.0, 0.01, 1, np.zeros(3), own)
    other = Fit(OTHER_END, np.eye(3), 0.86, 0.0, 0.01, 1, np.zeros(3), Verdict.HOLDS)
    state = robot.state
    state.relocalisation.suspicion.question = asked = Question(False, False, False, share=0.6, odd=odd)
    looked = Looked(None, (here,), ((other, ()),), True, 0)  # type: ignore[arg-type]  # nothing asks for the terrain
    kidnap_detection.answered(state, asked, looked)
    assert (state.map.parts.detached is not None) is (odd or own is not Verdict.HOLDS)
    state.motion.odometry = True
    assert state.map.parts.detached is None or relocalisation.dead_reckons(state) is not odd


@pytest.mark.parametrize(("own", "carried"), [(Verdict.HOLDS, False), (Verdict.OPEN, True)])
def test_a_search_that_is_cut_off_twice_gives_no_pose_up_that_the_map_confirms(own: Verdict, carried: bool) -> None:
    robot = driven(CUPBOARD, ABOUT)
    assert robot.T is not None
    here = Fit(robot.T, np.eye(3), 0.7, 0.0, 0.01, 1, np.zeros(3), own)
    state = robot.state
    state.relocalisation.suspicion.question = asked = Question(False, True, True, share=0.6, odd=False)
    looked = Looked(None, (here,), (), False, 0)  # type: ignore[arg-type]  # nothing asks for the terrain
    kidnap_detection.answered(state, asked, looked)
    assert (state.map.parts.detached is not None) is carried


def test_a_lost_search_is_repeated_and_is_no_sign_of_motion() -> None:
    robot = driven(CUPBOARD, ABOUT)
    assert robot.T is not None
    doubt, lost = robot.state.relocalisation.suspicion, Question(False, True, False, odd=False)
    doubt.question, doubt.t_asked, doubt.since = lost, robot.t - 11.0, robot.state.map.next_key
    robot.late = 45
    for _ in range(6):
        robot.at(robot.T)
    assert doubt.question not in (None, lost)
    assert not doubt.question.moved()


@pytest.mark.parametrize(
    ("shares", "unresolved"),
    [((), True), ((-1.0, -1.0), True), ((0.0, 0.0), False), ((0.2, 0.25, 0.2), False), ((0.6, 0.8, 0.7), True)],
)
def test_after_a_rest_scans_that_see_through_most_of_the_map_tell_a_kidnapping(
    shares: tuple[float, ...], unresolved: bool
) -> None:
    """A fifth may be a door, or people who were mapped: half of the scans without a match see that much."""
    robot = driven(CUPBOARD, ABOUT)
    state, doubt = robot.state, robot.state.relocalisation.suspicion
    doubt.unwatched_s, doubt.t_still, state.matching.t_match = 5.0, state.motion.t_mono, state.motion.t_mono - 6.0
    assert kidnap_opportunity.since_match(state)
    for share in shares:
        doubt.contradiction.add(share)
    assert kidnap_opportunity.unresolved(state) is unresolved
