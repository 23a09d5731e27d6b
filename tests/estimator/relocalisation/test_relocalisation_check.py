"""A place that was found is held against what is seen from there on, and given up when that contradicts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.light_filter.light_channel import LightChannel, LightsSetup
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.mapping.live_grid import LiveGrid, go_on
from estimator.mapping.loop_closure import take_answer
from estimator.mapping.loop_verification import LoopSettings
from estimator.mapping.submap_graph import SubmapGraph
from estimator.measurements import Answer
from estimator.relocalisation import relocalisation, relocalisation_check
from estimator.relocalisation.global_scan_match import Fit, Looked, Verdict
from estimator.relocalisation.hypothesis_tracking import Watch
from estimator.state import State
from estimator.stored_map import image_of
from tests.estimator.circuit import driven, run_jobs


def watched(until_m: float = 1e6) -> tuple[State, Watch, Keyframe]:
    """A robot that was found in a map that ends before its newest submap."""
    state, _ = driven(laps=0.6, settings=None)
    state.use(replace(state.settings, loops=LoopSettings()))
    newest = state.map.graph.newest
    assert newest is not None
    state.map.parts.trial = Watch(first=newest.key, until_m=until_m)
    return state, state.map.parts.trial, next(reversed(state.map.keyframes.values()))


def looked(verdict: Verdict) -> Looked:
    fit = Fit(np.zeros(3), np.eye(3), 0.9, 0.0, 0.01, 1, np.zeros(3), verdict)
    return Looked(None, (fit,), (), None, 0)  # type: ignore[arg-type]  # nothing asks for the terrain


@pytest.mark.parametrize(
    ("verdicts", "lost"),
    [
        ([Verdict.NO] * 3, True),
        ([Verdict.NO] * 2, False),
        ([Verdict.NO, Verdict.NO, Verdict.HOLDS, Verdict.NO, Verdict.NO], False),
        ([Verdict.NO, Verdict.OPEN, Verdict.NO, Verdict.OPEN, Verdict.NO], True),
        ([Verdict.OPEN] * 9, False),
    ],
)
def test_three_contradictions_without_one_that_holds_end_it(verdicts: list[Verdict], lost: bool) -> None:
    state, seen, _ = watched()
    for verdict in verdicts:
        relocalisation_check.take_check(state, seen, looked(verdict))
    assert (state.map.parts.detached is not None) == lost
    assert (state.map.parts.trial is None) == lost


@pytest.mark.parametrize("expected", [True, False])
def test_a_revoked_pose_to_which_odometry_had_led_is_carried_on_by_it(expected: bool) -> None:
    state, seen, _ = watched()
    seen.expected = expected
    for _ in range(3):
        relocalisation_check.take_check(state, seen, looked(Verdict.NO))
    assert relocalisation.dead_reckons(state) is expected


def test_an_answer_to_a_place_given_up_meanwhile_counts_for_nothing() -> None:
    state, seen, _ = watched()
    state.map.parts.trial = None
    for _ in range(5):
        relocalisation_check.take_check(state, seen, looked(Verdict.NO))
    assert state.map.parts.detached is None


def test_a_keyframe_is_held_against_the_older_map_alone_and_one_look_at_a_time() -> None:
    state, seen, frame = watched()
    state.jobs.take()
    relocalisation_check.keyframe_laid(state, frame)
    relocalisation_check.keyframe_laid(state, frame)
    (job,) = state.jobs.take()
    found = job.run()
    assert isinstance(found, Looked)
    assert {piece.key for piece in found.terrain.pieces} == {
        key for key, submap in state.map.graph.submaps.items() if key < seen.first and submap.settled is not None
    }
    assert len(found.guesses) == 1
    assert found.fresh == ()


@pytest.mark.parametrize("witness", [True, False])
def test_one_witness_of_the_map_against_a_place_where_light_has_the_robot_does_not_count(
    witness: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A door that stood open then is shut now."""
    state, _, frame = watched()
    state.light = LightChannel(LightsSetup())
    monkeypatch.setattr("estimator.relocalisation.light_evidence.witness", lambda *_: witness)
    monkeypatch.setattr(relocalisation_check, "look", lambda query, _: query.outvoted)
    state.jobs.take()
    relocalisation_check.keyframe_laid(state, frame)
    (job,) = state.jobs.take()
    assert job.run() is witness


def test_after_its_way_the_watch_is_over() -> None:
    state, _, frame = watched(until_m=0.1)
    state.jobs.take()
    relocalisation_check.keyframe_laid(state, frame)
    assert state.map.parts.trial is None
    assert state.jobs.take() == ()


def test_what_was_mapped_in_a_place_that_was_the_wrong_one_goes_if_the_laser_alone_had_decided() -> None:
    for alone in (True, False):
        state, seen, frame = watched()
        newest = frame.submap
        seen.since, seen.alone = newest.first, alone
        older = {key: one for key, one in state.map.keyframes.items() if key < newest.first}
        assert (newest.key in {piece.key for piece in image_of(state).unsettled}) == (not alone)
        for _ in range(relocalisation_check.STRIKES):
            relocalisation_check.take_check(state, seen, looked(Verdict.NO))
        assert (newest.key in state.map.graph.submaps) == (not alone)
        assert (newest.key in state.map.graph.constraints.between) == (not alone)
        assert (state.map.keyframes == older) == alone
        assert state.map.parts.detached == newest.key + (not alone)


def test_the_live_map_no_longer_shows_it() -> None:
    state, seen, frame = watched()
    seen.since, seen.alone = frame.submap.first, True
    live = state.map.live = LiveGrid(0.1)
    live.laid(frame.submap, state.map.graph.frames)
    go_on(state.map.live, state.map.graph)
    run_jobs(state)
    assert any(cells.any() for _, cells in live.tiles.values())
    live.laid(frame.submap, state.map.graph.frames)
    go_on(state.map.live, state.map.graph)  # one more drawing of it is under way
    late = state.jobs.take()
    assert late
    for _ in range(relocalisation_check.STRIKES):
        relocalisation_check.take_check(state, seen, looked(Verdict.NO))
    for job in late:
        take_answer(state.map, state.pose, state.motion, Answer(0.0, job.job_id, job.run()))
    go_on(state.map.live, state.map.graph)
    run_jobs(state)
    assert not any(cells.any() for _, cells in live.tiles.values())


def test_what_is_watched_takes_the_place_of_nothing_older() -> None:
    for key in (3, 0):
        atlas = SubmapGraph()
        for k in range(1, 5):
            atlas.submaps[k] = Submap(k, k, np.zeros(3), np.zeros(3))
            if k > 1:
                atlas.constraints.add(k - 1, k, np.zeros(3), np.eye(3), False)
        atlas.parts.trial = Watch(first=key, until_m=1e6) if key else None
        atlas.thin_out(atlas.submaps[4])
        assert list(atlas.submaps) == ([1, 2, 3, 4] if key else [3, 4])
