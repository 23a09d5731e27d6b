"""Solutions of the graph that come after the map has moved: as one, which they follow, or in part."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from estimator.mapping.loop_closure import take_answer
from estimator.mapping.map_frame import shift_map
from estimator.measurements import Answer, Job
from estimator.numerics import se2
from estimator.state import State
from tests.estimator.circuit import TOLD, driven

pytestmark = pytest.mark.jit  # whole maps

MOVED = np.array((5.0, -1.0, 2.5))


@pytest.fixture(scope="module")
def drifted() -> State:
    """With loops that the graph has not heard of."""
    state, _ = driven(settings=None)
    state.use(replace(state.settings, loops=TOLD))
    atlas = state.map.graph
    a, *_, b = atlas.submaps.values()
    T = se2.between(a.T_map_submap, b.T_map_submap) + np.array((0.1, -0.05, 0.02))
    atlas.constraints.add(a.key, b.key, T, np.diag((0.01**2, 0.01**2, 0.005**2)), True)
    atlas.stale = True
    return state


def asked(state: State) -> Job:
    take_answer(
        state.map, state.pose, state.motion, Answer(0.0, -1, None)
    )  # nobody asked: only makes the graph be handed out
    return state.jobs.take()[-1]


def test_a_map_that_moved_as_one_takes_the_solution_along(drifted: State) -> None:
    state, still = deepcopy(drifted), deepcopy(drifted)
    for one, moved in ((state, MOVED), (still, se2.identity())):
        job = asked(one)
        shift_map(one.map, moved, 0)
        one.pose.T_map_odom = se2.compose(moved, one.pose.T_map_odom)
        take_answer(one.map, one.pose, one.motion, Answer(0.0, job.job_id, job.run()))
        assert not one.map.graph.stale
    was, places, there = (
        np.array([submap.T_map_submap for submap in one.map.graph.submaps.values()]) for one in (drifted, still, state)
    )
    assert np.abs(places - was).max() > 0.02, "the loop has moved the map"
    np.testing.assert_allclose(se2.compose_all(MOVED, places), there, atol=1e-9)
    np.testing.assert_allclose(se2.compose(MOVED, still.pose.T_map_odom), state.pose.T_map_odom, atol=1e-9)
    np.testing.assert_allclose(still.map.graph.marginal, state.map.graph.marginal, atol=1e-12)
    for key, P in still.map.graph.ties.items():
        np.testing.assert_allclose(P, state.map.graph.ties[key], atol=1e-12)


def test_a_map_of_which_a_part_moved_is_solved_again(drifted: State) -> None:
    state = deepcopy(drifted)
    job = asked(state)
    _, middle, *_ = state.map.graph.submaps.values()
    shift_map(state.map, MOVED, middle.first)
    before = [submap.T_map_submap.copy() for submap in state.map.graph.submaps.values()]
    take_answer(state.map, state.pose, state.motion, Answer(0.0, job.job_id, job.run()))
    np.testing.assert_array_equal(before, [submap.T_map_submap for submap in state.map.graph.submaps.values()])
    assert state.jobs.take(), "it is handed out once more"
