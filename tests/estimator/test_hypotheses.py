"""Places where a robot may be: what rules one out, and what makes one sure."""

from __future__ import annotations

import numpy as np
import pytest

from estimator import se2
from estimator.hypotheses import HELD, Hypothesis, Seek
from estimator.keyframe import Keyframe, keep
from estimator.relocate import Fit, Looked, Terrain, Verdict
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


HOLDS, OPEN, NO = Verdict.HOLDS, Verdict.OPEN, Verdict.NO


def test_a_look_that_speaks_against_a_place_rules_it_out() -> None:
    assert looked_at([HOLDS, OPEN, NO, OPEN])[1] is None


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
