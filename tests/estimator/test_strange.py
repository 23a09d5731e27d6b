"""A robot whose wheels stand while what it sees speaks against its place: it may be carried on, from scan to scan."""

from __future__ import annotations

import numpy as np
import pytest

from estimator import se2, suspicion
from estimator.matching import no_match
from estimator.pipeline import new_state
from estimator.records import Odometry
from estimator.result import Reason
from estimator.scanpoints import points_of
from tests.estimator.adrift import BEAMS
from tests.estimator.test_suspicion import IMAGE, driven, stand
from tests.estimator.world import scan_in
from tools.bench._scenes import Scene

pytestmark = pytest.mark.jit


def niches(count: int = 8, apart: float = 5.0) -> Scene:
    """A corridor, 2 m wide, with a niche to the left every few metres: it looks the same from one to the next."""
    walls = [(0.0, -1.0, count * apart, -1.0), (0.0, -1.0, 0.0, 1.0), (count * apart, -1.0, count * apart, 1.0)]
    for x in (np.arange(count) * apart).tolist():
        walls += [(x, 1.0, x + 1.0, 1.0), (x + 1.0, 1.0, x + 1.0, 3.0), (x + 1.0, 3.0, x + 2.2, 3.0)]
        walls += [(x + 2.2, 3.0, x + 2.2, 1.0), (x + 2.2, 1.0, x + apart, 1.0)]
    return Scene(np.array(walls), (0.4, -0.6), (count * apart - 0.4, 0.6))


def test_carried_along_a_corridor_to_where_it_looks_alike_as_the_scans_in_between_have_shown() -> None:
    """From scan to scan little changes, every other one fits, and what is seen at last is what was seen at first."""
    robot = driven(niches(), ((2.0, 0.0), (38.0, 0.0), (22.5, 0.0)))
    assert robot.T is not None
    here = robot.T
    assert set(stand(robot, here, 10)) == {None}
    for metres in np.linspace(0.2, 10.0, 50).tolist():
        robot.at(here - np.array((metres, 0.0, 0.0)), carried=True)
    said = stand(robot, here - np.array((10.0, 0.0, 0.0)), 15)
    assert None not in said[5:]
    assert robot.off()[0] > 9.0, "it fits as well where it was"


def test_people_who_step_about_a_robot_that_stands_are_nothing_strange() -> None:
    """They hide walls; through none of these is looked."""
    robot = driven(niches(), ((2.0, 0.0), (38.0, 0.0), (22.5, 0.0)))
    assert robot.T is not None
    here, asked = robot.T, robot.state.suspicion.t_asked
    stand(robot, here, 10)
    x, y, _ = here.tolist()
    empty = robot.scene
    for k in range(60):
        legs = [(x - 1.2 + 0.04 * k, y + side, x - 1.0 + 0.04 * k, y + side) for side in (-0.7, 0.5, 0.8)]
        robot.scene = Scene(np.vstack((empty.walls, np.array(legs))), empty.low, empty.high)
        assert robot.at(here, carried=True).places is None
    assert robot.state.suspicion.t_asked == asked


class Looker:
    """A robot whose scans speak against its place, or not, as they are told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, period: float = 0.1) -> None:
        self.state, self.t, self.period, self.against, self.usual = new_state(), 0.0, period, False, 0.0
        self.state.suspicion.period_s = period
        monkeypatch.setattr(suspicion, "speaking_against", lambda *_: 0.25 if self.against else self.usual)

    def scans(self, count: int, against: bool, ok: bool = True, way: float | None = 0.0) -> list[bool]:
        """What is said of so many; ``way``: that the wheels make meanwhile, each time; None: they tell nothing."""
        self.against, said = against, []
        for _ in range(count):
            begin, self.t = self.t, self.t + self.period
            if way is not None:
                self.state.fused.t_odometry = self.t
                suspicion.on_odometry(self.state, Odometry(begin, self.t, np.array((way, 0.0, 0.0))))
            self.state.fused.t_mono, self.state.t_scan = self.t, begin
            scan = scan_in(IMAGE, se2.identity(), BEAMS, np.random.default_rng(0), t=self.t)
            points = points_of(scan, se2.identity(), 80.0, 0.0)
            match = no_match(se2.identity(), 1, Reason.CONVERGED if ok else Reason.REJECTED)
            said.append(suspicion.was_strange(self.state, scan, points, match))
        return said


@pytest.mark.parametrize("period", [0.1, 0.025])
def test_what_was_strange_for_long_enough_is_told_with_the_first_scan_that_fits_again(
    monkeypatch: pytest.MonkeyPatch, period: float
) -> None:
    looker = Looker(monkeypatch, period)
    looker.scans(round(1.0 / period), False)
    short, enough = round(0.4 / period), round(0.15 / period) + 1
    assert not any(looker.scans(short, True)), "still strange"
    assert not any(looker.scans(round(1.2 / period), False)), "too short, and forgotten"
    assert not any(looker.scans(short, True) + looker.scans(2, False) + looker.scans(enough, True))
    assert not any(looker.scans(3, False, ok=False)), "which cannot be matched"
    assert looker.scans(3, False) == [True, False, False]


@pytest.mark.parametrize("way", [None, 0.3, 0.002])
def test_where_wheels_turn_or_tell_nothing_nothing_is_strange(
    monkeypatch: pytest.MonkeyPatch, way: float | None
) -> None:
    """However slowly they turn."""
    looker = Looker(monkeypatch)
    looker.scans(10, False, way=way)
    assert not any(looker.scans(20, True, way=way) + looker.scans(5, False, way=way))


def test_what_has_just_stopped_still_rolls(monkeypatch: pytest.MonkeyPatch) -> None:
    looker = Looker(monkeypatch)
    looker.scans(10, False, way=0.1)
    assert not any(looker.scans(8, True) + looker.scans(1, False))
    looker.scans(10, False)
    looker.scans(6, True)
    assert looker.scans(1, False) == [True]


def test_what_the_map_has_wrong_where_the_robot_stopped_is_not_strange(monkeypatch: pytest.MonkeyPatch) -> None:
    """A table that has been moved speaks against the place for as long as the robot stands there."""
    looker = Looker(monkeypatch)
    looker.usual = 0.16
    looker.scans(10, False)
    assert not any(looker.scans(20, True) + looker.scans(10, False))
    looker.usual = 0.05
    looker.scans(1, False, way=0.1)
    looker.scans(10, False)
    assert not any(looker.scans(20, True))
    assert looker.scans(1, False) == [True], "that was of the place before"


def test_what_was_strange_is_told_though_the_wheels_turn_by_then(monkeypatch: pytest.MonkeyPatch) -> None:
    looker = Looker(monkeypatch)
    looker.scans(10, False)
    looker.scans(6, True)
    assert looker.scans(2, True, way=0.1) == [True, False]
