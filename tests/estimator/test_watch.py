"""A place that was found is held against what is seen from there on, and given up when that contradicts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator import watch
from estimator.hypotheses import Watch
from estimator.keyframe import Keyframe
from estimator.loop import LoopSettings
from estimator.relocate import Fit, Looked, Verdict
from estimator.state import State
from tests.estimator.test_closing import driven


def watched(until_m: float = 1e6) -> tuple[State, Watch, Keyframe]:
    """A robot that was found in a map that ends before its newest submap."""
    state, _ = driven(laps=0.6, settings=None)
    state.settings = replace(state.settings, loops=LoopSettings())
    newest = state.atlas.newest
    assert newest is not None
    state.atlas.watch = Watch(newest.key, until_m, None)
    return state, state.atlas.watch, next(reversed(state.keyframes.values()))


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
        watch.take(state, seen, looked(verdict))
    assert (state.atlas.adrift is not None) == lost
    assert (state.atlas.watch is None) == lost


def test_an_answer_to_a_place_given_up_meanwhile_counts_for_nothing() -> None:
    state, seen, _ = watched()
    state.atlas.watch = None
    for _ in range(5):
        watch.take(state, seen, looked(Verdict.NO))
    assert state.atlas.adrift is None


def test_a_keyframe_is_held_against_the_older_map_alone_and_one_look_at_a_time() -> None:
    state, seen, frame = watched()
    state.atlas.take_jobs()
    watch.keyframe_laid(state, frame)
    watch.keyframe_laid(state, frame)
    (job,) = state.atlas.take_jobs()
    found = job.run()
    assert isinstance(found, Looked)
    assert {piece.key for piece in found.terrain.pieces} == {
        key for key, submap in state.atlas.submaps.items() if key < seen.first and submap.settled is not None
    }
    assert len(found.guesses) == 1
    assert found.fresh == ()


def test_after_its_way_the_watch_is_over() -> None:
    state, _, frame = watched(until_m=0.1)
    state.atlas.take_jobs()
    watch.keyframe_laid(state, frame)
    assert state.atlas.watch is None
    assert state.atlas.take_jobs() == ()
