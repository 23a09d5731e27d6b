"""Where in the whole map a keyframe fits: what may rule a new place out."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from estimator.mapping.keyframe import Keyframe, keep
from estimator.mapping.loop_verification import LoopSettings
from estimator.measurements import Array
from estimator.numerics import se2
from estimator.relocalisation import global_scan_match
from estimator.relocalisation.global_scan_match import POSSIBLE, Piece, Query, Verdict, look, same
from estimator.scan_matching.branch_and_bound import Around
from tests.estimator.adrift import BEAMS, furnished, mapped
from tests.estimator.world import scan_in

pytestmark = pytest.mark.jit

TOUR = ((1.0, 6.0), (10.8, 6.0), (1.85, 6.0), (1.85, 1.5), (1.85, 6.0), (5.85, 6.0), (5.85, 1.5))
HERE, EARLIER = np.array((1.85, 3.0, -1.5)), np.array((5.85, 3.0, -1.2))


@cache
def pieces() -> tuple[Piece, ...]:
    return tuple(Piece(key, T, settled) for key, (T, settled) in enumerate(mapped(furnished(), TOUR), 1))


def seen_from(key: int, T: Array, T_odom: Array) -> Keyframe:
    rng = np.random.default_rng(key)
    return keep(key, T_odom, T_odom, scan_in(furnished(), T, BEAMS, rng), 0.0)


@pytest.mark.parametrize(("carried", "outvoted", "found"), [(0, 0, 1), (1, 0, 0), (1, 1, 1)])
def test_what_was_seen_before_rules_a_new_place_out_unless_light_or_a_person_has_the_robot_there(
    carried: bool, outvoted: bool, found: bool
) -> None:
    """A keyframe taken in somebody's hands is off by what the wheels have not counted."""
    frame = seen_from(2, HERE, np.zeros(3))
    before = seen_from(1, EARLIER, np.zeros(3) if carried else se2.between(HERE, EARLIER))
    window = Around(np.array((*HERE[:2], 0.0)), 0.9, np.pi)
    query = Query(frame, pieces(), None, (), (before,), windows=(window,), outvoted=outvoted)
    places = [one.T_map_keyframe for one, _ in look(query, LoopSettings()).fresh]
    assert any(same(HERE, T) for T in places) == found


@pytest.mark.parametrize("firm", [False, True])
@pytest.mark.parametrize("second", [0.1, 0.3])
def test_one_witness_alone_rules_no_place_out_that_earlier_looks_have_held(
    firm: bool, second: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A door that stood open is shut now: of two places that look alike the right one would be gone, and the wrong one
    be sure."""
    monkeypatch.setattr(global_scan_match, "worst", lambda *_: (0.36, second))
    query = Query(seen_from(2, HERE, np.zeros(3)), pieces(), None, (HERE,), (), search=False, firm=(firm,))
    (one,) = look(query, LoopSettings()).guesses
    assert one.share > 0.9
    assert one.verdict is (Verdict.OPEN if firm and second < POSSIBLE else Verdict.NO)
