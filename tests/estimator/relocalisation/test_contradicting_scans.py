"""A robot whose wheels stand while what it sees speaks against its place: it may be carried on, from scan to scan."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.measurements import Odometry
from estimator.numerics import se2
from estimator.pipeline import new_state
from estimator.relocalisation import kidnap_detection
from estimator.result import Reason
from estimator.scan_matching.deskew import points_of
from estimator.scan_matching.scan_matcher import no_match
from tests.estimator.adrift import BEAMS
from tests.estimator.relocalisation.test_kidnap_detection import IMAGE, driven, stand
from tests.estimator.world import scan_in
from tools.bench.support.scenes import Scene

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


def crowd(at: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(4 * count, 4) sides of people, 0.35 m wide, who shuffle about a robot in a corridor."""
    x, y, _ = at.tolist()
    sides = []
    for _ in range(count):
        cx, cy = x + rng.choice((-1.0, 1.0)) * rng.uniform(0.6, 2.5), y + rng.uniform(-0.8, 0.8)
        corners = [(cx - 0.17, cy - 0.17), (cx + 0.17, cy - 0.17), (cx + 0.17, cy + 0.17), (cx - 0.17, cy + 0.17)]
        sides += [(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    return np.array(sides)


def test_people_who_step_up_to_a_robot_that_stands_and_leave_are_nothing_strange(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They hide walls, and hang in what was free; but nobody looks through a wall for them."""
    told: list[bool] = []
    usual = kidnap_detection.was_strange

    def heard(*words: object) -> bool:
        told.append(usual(*words))  # type: ignore[arg-type]
        return told[-1]

    robot = driven(niches(), ((2.0, 0.0), (38.0, 0.0), (22.5, 0.0)))
    assert robot.T is not None
    here, empty, rng = robot.T, robot.scene, np.random.default_rng(3)
    stand(robot, here, 10)
    monkeypatch.setattr(kidnap_detection, "was_strange", heard)
    for k in range(80):
        if k % 5 == 0:
            about = [crowd(here, min(10, k // 5), rng)] if 0 < k < 60 else []
            robot.scene = Scene(np.vstack((empty.walls, *about)), empty.low, empty.high)
        robot.at(here, carried=True)
        assert robot.state.relocalisation.suspicion.strange_s == 0.0
    assert len(told) == 80
    assert not any(told)


class Looker:
    """A robot whose scans speak against its place, or not, as they are told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, period: float = 0.1) -> None:
        self.state, self.t, self.period, self.against, self.usual = new_state(), 0.0, period, False, 0.0
        self.state.relocalisation.suspicion.period_s = period
        self.share = 0.25
        monkeypatch.setattr(kidnap_detection, "looked_through", lambda *_: self.share if self.against else self.usual)

    def scans(
        self, count: int, against: bool, ok: bool = True, way: float | None = 0.0, yaw: float = 0.0
    ) -> list[bool]:
        """What is said of so many; ``way``, ``yaw``: of the wheels meanwhile, each time; None: they tell nothing."""
        self.against, said = against, []
        for _ in range(count):
            begin, self.t = self.t, self.t + self.period
            if way is not None:
                self.state.motion.t_odometry = self.t
                kidnap_detection.on_odometry(self.state, Odometry(begin, self.t, np.array((way, 0.0, yaw))))
            self.state.motion.t_mono, self.state.matching.t_scan = self.t, begin
            scan = scan_in(IMAGE, se2.identity(), BEAMS, np.random.default_rng(0), t=self.t)
            points = points_of(scan, se2.identity(), 80.0, 0.0)
            match = no_match(se2.identity(), 1, Reason.CONVERGED if ok else Reason.REJECTED)
            said.append(kidnap_detection.was_strange(self.state, scan, points, match))
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
    for strange in (2, 5):
        looker.scans(10, False, way=0.1)
        assert not any(looker.scans(strange, True) + looker.scans(10, False))
        assert looker.state.relocalisation.suspicion.t_strange == -np.inf
    looker.scans(10, False, way=0.1)
    looker.scans(4, False)
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


@pytest.mark.parametrize("every", [7, 10, 100])
def test_wheels_that_are_jostled_while_the_robot_is_carried_hide_nothing(
    monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    looker = Looker(monkeypatch)
    looker.scans(10, False)
    for k in range(21):
        looker.scans(1, True, way=0.006 if k % every == 2 else 0.0)
    assert looker.scans(1, False) == [True]


@pytest.mark.parametrize("rad_s", [0.0005, 0.002])
def test_a_heading_that_drifts_while_the_robot_stands_hides_nothing(
    monkeypatch: pytest.MonkeyPatch, rad_s: float
) -> None:
    looker = Looker(monkeypatch)
    looker.scans(600, False, yaw=0.1 * rad_s)
    looker.scans(15, True, yaw=0.1 * rad_s)
    assert looker.scans(1, False, yaw=0.1 * rad_s) == [True]


@pytest.mark.parametrize("period", [0.25, 0.5, 1.0, 2.0])
def test_of_a_slow_lidar_s_scans_two_are_not_for_a_while(monkeypatch: pytest.MonkeyPatch, period: float) -> None:
    looker = Looker(monkeypatch, period)
    looker.scans(10, False)
    assert not any(looker.scans(2, True) + looker.scans(10, False))
    looker.scans(3, True)
    assert looker.scans(1, False) == [True]


def test_what_stays_strange_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put down where it looks alike but for a table: it would not be over before the robot drives."""
    looker = Looker(monkeypatch)
    looker.scans(10, False)
    said = looker.scans(60, True)
    assert said.index(True) in (29, 30)
    assert sum(said) == 1
    assert not any(looker.scans(10, True, ok=False) + looker.scans(10, False))


def test_what_stays_strange_is_not_told_of_a_scan_that_is_not_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    looker = Looker(monkeypatch)
    looker.scans(10, False)
    assert not any(looker.scans(60, True, ok=False))
    assert looker.scans(1, True) == [True]


def test_wheels_that_fall_silent_are_not_known_to_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    looker = Looker(monkeypatch)
    looker.scans(10, False)
    assert not any(looker.scans(30, True, way=None) + looker.scans(5, False, way=None))


def test_a_gap_between_scans_does_not_count_as_strange(monkeypatch: pytest.MonkeyPatch) -> None:
    looker = Looker(monkeypatch)
    looker.scans(10, False)
    for _ in range(3):
        looker.scans(1, True)
        looker.period = 0.4
        looker.scans(1, True)
        looker.period = 0.1
    assert looker.state.relocalisation.suspicion.strange_s == pytest.approx(0.6)  # six scans
    looker.state.relocalisation.suspicion.strange_s = 0.0
    late = looker.t
    looker.scans(1, True)
    looker.state.matching.t_scan = looker.t = late  # a scan that is no later than the one before
    assert looker.state.relocalisation.suspicion.strange_s == pytest.approx(0.1)


@pytest.mark.parametrize(("between", "told"), [(8, True), (12, False)])
def test_what_was_strange_a_second_ago_is_forgotten(monkeypatch: pytest.MonkeyPatch, between: int, told: bool) -> None:
    looker = Looker(monkeypatch)
    looker.scans(10, False)
    looker.scans(4, True)
    looker.scans(between, False)
    looker.scans(2, True)
    assert looker.scans(1, False) == [told]


@pytest.mark.parametrize(("more", "told"), [(0.09, False), (0.11, True)])
def test_a_tenth_more_than_when_the_wheels_stopped_is_strange(
    monkeypatch: pytest.MonkeyPatch, more: float, told: bool
) -> None:
    looker = Looker(monkeypatch)
    looker.usual, looker.share = 0.1, 0.1 + more
    looker.scans(10, False)
    looker.scans(8, True)
    assert looker.scans(1, False) == [told]


def test_one_blurred_scan_when_the_wheels_stop_is_not_what_is_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    looker = Looker(monkeypatch)
    looker.scans(5, False, way=0.1)
    looker.scans(3, True)  # the last of them is looked at, as the first one
    looker.scans(8, False)
    looker.scans(8, True)
    assert looker.scans(1, False) == [True]


def test_stamps_of_the_wheels_that_go_back_begin_the_rest_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    looker = Looker(monkeypatch)
    looker.scans(5, False, way=0.1)
    assert looker.state.relocalisation.suspicion.t_rest == 0.5
    kidnap_detection.on_odometry(looker.state, Odometry(0.2, 0.3, np.zeros(3)))
    assert looker.state.relocalisation.suspicion.t_rest == 0.3
