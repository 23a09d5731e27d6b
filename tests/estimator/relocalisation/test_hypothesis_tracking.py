"""Places where a robot may be: what rules one out, and what makes one sure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.mapping.keyframe import Keyframe, keep
from estimator.numerics import se2
from estimator.relocalisation.global_scan_match import Fit, Looked, Terrain, Verdict
from estimator.relocalisation.hypothesis_tracking import HELD, Hypothesis, Seek
from estimator.scan_matching.branch_and_bound import Around
from tests.estimator.adrift import BEAMS, furnished
from tests.estimator.world import scan_in

SMALL = 1e-4 * np.eye(3)
TERRAIN = Terrain((), None)  # type: ignore[arg-type]  # nothing is searched here


def frame_at(x: float) -> Keyframe:
    T = np.array((x, 6.0, 0.0))
    return keep(1, T, T, scan_in(furnished(), T, BEAMS, None), 0.0)


def fit(frame: Keyframe, verdict: Verdict) -> Fit:
    T = frame.T_odom_keyframe
    return Fit(T, SMALL, 0.9, 0.0, 0.01, 1, T, verdict)


def looked_at(verdicts: list[Verdict]) -> tuple[Seek, Hypothesis | None]:
    """One place after looks half a metre apart, the last of which was a complete search."""
    seek = Seek(alive=(Hypothesis(se2.identity()),))
    for k, verdict in enumerate(verdicts):
        frame = frame_at(1.0 + 0.5 * k)
        seek.take(frame, seek.alive, Looked(TERRAIN, tuple(fit(frame, verdict) for _ in seek.alive), (), True, 0))
    return seek, seek.alive[0] if seek.alive else None


def test_an_earlier_keyframe_that_speaks_against_a_place_that_was_offered_all_the_same_is_no_look_at_it() -> None:
    seek, frame = Seek(past=(frame_at(0.0), frame_at(0.7))), frame_at(1.4)
    earlier = tuple(fit(before, verdict) for before, verdict in zip(seek.past, (NO, HOLDS), strict=True))
    seek.take(frame, (), Looked(TERRAIN, (), ((fit(frame, HOLDS), earlier),), True, 0))
    (one,) = seek.alive
    assert (one.looks, one.holds) == (2, 2)


HOLDS, OPEN, NO = Verdict.HOLDS, Verdict.OPEN, Verdict.NO


def test_a_look_that_speaks_against_a_place_rules_it_out() -> None:
    assert looked_at([HOLDS, OPEN, NO, OPEN])[1] is None


@pytest.mark.parametrize(("looks", "firm"), [(2, False), (3, True)])
def test_a_place_is_firm_once_enough_looks_have_held_it(looks: int, firm: bool) -> None:
    one = looked_at([HOLDS] * looks)[1]
    assert one is not None
    assert one.firm() is firm


@pytest.mark.parametrize(
    ("verdicts", "sure"),
    [
        ([HOLDS] * HELD, True),
        ([OPEN, OPEN, HOLDS, HOLDS, HOLDS], True),
        ([HOLDS, HOLDS, OPEN, OPEN, OPEN, OPEN, OPEN, OPEN, OPEN, HOLDS], False),
        ([HOLDS, OPEN, OPEN, OPEN, HOLDS, OPEN, HOLDS], False),
    ],
)
def test_a_place_that_most_looks_leave_open_is_not_sure(verdicts: list[Verdict], sure: bool) -> None:
    seek, one = looked_at(verdicts)
    assert one is not None
    assert seek.favourite() is one
    assert seek.sure(one, False) is sure
    assert seek.sure(one, True), "a second witness makes it so"


def half_fitting(frame: Keyframe, share: float, x: float = 0.0) -> Fit:
    """A look that leaves a place open, ``x`` metres off it, though its axes are well known."""
    T = frame.T_odom_keyframe + np.array((x, 0.0, 0.0))
    return replace(fit(frame, OPEN), share=share, T_map_keyframe=T)


@pytest.mark.parametrize(
    ("share", "looks", "drift_m", "found"),
    [(0.55, 3, 0.0, True), (0.55, 2, 0.0, False), (0.45, 3, 0.0, False), (0.55, 3, 0.2, False), (0.8, 1, 0.2, True)],
)
def test_where_half_of_the_beams_fit_look_after_look_has_to_find_the_same_place(
    share: float, looks: int, drift_m: float, found: bool
) -> None:
    """Furniture was moved: no look holds the place, and nothing else fits."""
    seek = Seek(alive=(Hypothesis(se2.identity()),))
    for k in range(looks):
        frame = frame_at(1.0 + 0.5 * k)
        fits = tuple(half_fitting(frame, share, drift_m * (k == looks - 1)) for _ in seek.alive)
        seek.take(frame, seek.alive, Looked(TERRAIN, fits, (), True, 0))
    one = seek.favourite()
    assert (one is not None) is found
    if one is not None:
        assert seek.sure(one, True)
        assert not seek.sure(one, False), "the laser alone is not enough"


@pytest.mark.parametrize(("lost", "decided"), [(1, False), (2, True)])
def test_a_place_that_looks_have_lost_while_they_held_another_is_no_rival(lost: int, decided: bool) -> None:
    far = np.array((9.0, 0.0, np.pi))
    seek = Seek(alive=(Hypothesis(se2.identity()), Hypothesis(far)))
    for k in range(4 + lost):
        frame = frame_at(1.0 + 0.5 * k)
        there = fit(frame, HOLDS if k < 2 else OPEN)
        T = se2.compose(far, frame.T_odom_keyframe)
        there = replace(there, T_map_keyframe=T, share=0.8 if k < 2 else 0.0)
        if 2 <= k < 4:  # both are held until here
            there = replace(there, verdict=HOLDS, share=0.5)
        seek.take(frame, seek.alive, Looked(TERRAIN, (fit(frame, HOLDS), there), (), True, 0))
    assert len(seek.alive) == 2
    assert (seek.favourite() is not None) is decided


def test_a_place_that_was_held_and_then_nearly_is_as_good_as_one_that_never_was() -> None:
    """Somebody has come by: light is believed of it at once, and not only when it is held again."""
    for verdicts in ([HOLDS, OPEN, OPEN], [OPEN, OPEN, OPEN]):
        seek, one = looked_at(verdicts)
        assert one is not None
        best = seek.favourite()
        assert best is not None
        assert seek.sure(best, True)
        assert not seek.sure(best, False)


@pytest.mark.parametrize(("share", "against", "decided"), [(0.85, 0.0, False), (0.85, 0.14, True), (0.7, 0.0, True)])
def test_what_speaks_against_a_place_counts_beside_what_fits(share: float, against: float, decided: bool) -> None:
    """Turned round in a corridor nearly all beams fit, and the few that do not speak against it."""
    far = np.array((9.0, 0.0, np.pi))
    seek, frame = Seek(alive=(Hypothesis(se2.identity()), Hypothesis(far))), frame_at(1.0)
    there = replace(fit(frame, OPEN), T_map_keyframe=se2.compose(far, frame.T_odom_keyframe), share=share)
    seek.take(frame, seek.alive, Looked(TERRAIN, (fit(frame, HOLDS), replace(there, against=against)), (), True, 0))
    assert (seek.favourite() is not None) is decided


def test_light_that_has_come_to_have_the_robot_elsewhere_is_looked_for_there() -> None:
    def window(x: float) -> Around:
        return Around(np.array((x, 2.0, 0.0)), 0.8, np.pi)

    seek = Seek(around=(window(1.0), window(9.0)))
    assert not seek.elsewhere((window(1.5), window(9.4)))
    assert seek.elsewhere((window(1.0),))
    assert seek.elsewhere((window(1.0), window(3.0)))
    assert not Seek().elsewhere(())
