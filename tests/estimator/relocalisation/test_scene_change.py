"""What is seen changes all at once where a robot is put down elsewhere, and never where people walk or it drives."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.relocalisation.scene_change import CALM, Glance, Leap, differs, glance
from tests.estimator.adrift import BEAMS, way
from tests.estimator.world import scan_in
from tools.bench.support.scenes import Scene, box

pytestmark = pytest.mark.jit

ROOM = Scene(np.array(box(0.0, 0.0, 8.0, 6.0) + box(5.0, 2.0, 5.8, 2.8), dtype=np.float64), (0.5, 0.5), (7.5, 5.5))
HERE = np.array((2.0, 3.0, 0.0))
NOISE_M, USUAL_S = 0.01, 0.1


def with_more(*things: tuple[float, float, float, float]) -> Scene:
    """The room with boxes (low x, low y, high x, high y) in it."""
    walls = [wall for thing in things for wall in box(*thing)]
    return Scene(np.vstack((ROOM.walls, np.array(walls))), ROOM.low, ROOM.high) if walls else ROOM


def glances(views: Iterable[tuple[Scene, Array]], step_s: float = USUAL_S) -> list[Glance]:
    """A scan in each place."""
    rng, made = np.random.default_rng(3), []
    for k, (scene, T) in enumerate(views):
        scan = scan_in(scene, T, BEAMS, rng)
        eye, beams = se2.compose(T, scan.T_base_lidar), (scan.bearing_rad, scan.range_m, scan.beam)
        made.append(glance(step_s * k, eye, beams))
    return made


def seen(views: list[Glance]) -> list[bool]:
    """What is said of each."""
    leap, said = Leap(), []
    for one in views:
        leap.take(one, NOISE_M, USUAL_S)
        said.append(leap.seen)
    return said


def test_a_thing_that_is_there_from_one_scan_to_the_next_is_a_leap_and_told_once() -> None:
    there = with_more((3.5, 3.0, 4.2, 4.0))
    said = seen(glances([(ROOM, HERE)] * 6 + [(there, HERE)] * 10))
    assert said.index(True) == 6 + CALM - 1
    assert sum(said) == 1
    assert sum(seen(glances([(there, HERE)] * 6 + [(ROOM, HERE)] * 10))) == 1, "and so where it is gone"


def test_a_scan_that_is_half_of_one_and_half_of_the_other_does_not_hide_it() -> None:
    there, half = with_more((3.5, 2.7, 4.2, 4.2)), with_more((3.5, 2.7, 4.2, 3.4))
    assert sum(seen(glances([(ROOM, HERE)] * 6 + [(half, HERE)] + [(there, HERE)] * 10))) == 1


def test_a_change_that_may_have_taken_longer_is_none() -> None:
    """As behind a scan that was spoilt while others were lost: a door shuts in half a second."""
    there, half = with_more((3.5, 2.7, 4.2, 4.2)), with_more((3.5, 2.7, 4.2, 3.4))
    views = glances([(ROOM, HERE)] * 6 + [(half, HERE)] + [(there, HERE)] * 10)
    slower = [replace(one, t_end=one.t_end + 0.2 * (k >= 6) + 0.2 * (k >= 7)) for k, one in enumerate(views)]
    assert not any(seen(slower))


def test_somebody_who_walks_by_is_none() -> None:
    for speed in (0.05, 0.1, 0.15):
        walks = [(with_more((3.4, y, 3.6, y + 0.3)), HERE) for y in np.arange(0.5, 5.0, speed).tolist()]
        assert not any(seen(glances([(ROOM, HERE)] * 6 + walks + [(ROOM, HERE)] * 10)))


def test_what_comes_into_view_on_the_way_is_none() -> None:
    poses = way(((1.0, 1.0), (6.8, 1.0), (6.8, 5.0), (1.0, 5.0)), 0.08)
    made = glances([(ROOM, T) for T in poses])
    assert not any(seen(made))
    assert max(differs(a, b, NOISE_M) for a, b in pairwise(made)) < 0.005


def test_a_glitch_of_one_scan_is_none() -> None:
    there = with_more((3.5, 3.0, 4.2, 4.0))
    assert not any(seen(glances([(ROOM, HERE)] * 6 + [(there, HERE)] + [(ROOM, HERE)] * 10)))


@pytest.mark.parametrize("step_s", [0.8, 0.001])
def test_what_happens_between_scans_far_apart_or_in_a_burst_is_not_judged(step_s: float) -> None:
    """A door shuts in a second; and of a burst of scans that were kept waiting nobody knows when each was taken."""
    there = with_more((3.5, 3.0, 4.2, 4.0))
    assert not any(seen(glances([(ROOM, HERE)] * 6 + [(there, HERE)] * 10, step_s)))


def test_scans_that_see_hardly_anything_of_each_other_say_nothing() -> None:
    away = np.array((2.0, 3.0, np.pi))
    one, other = glances([(ROOM, HERE), (with_more((0.5, 2.5, 1.0, 3.5)), away)])
    few = replace(one, reach=one.reach[:20].copy(), kind=one.kind[:20].copy())
    assert differs(few, other, NOISE_M) == 0.0
