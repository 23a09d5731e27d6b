"""What `lumiloop why` says of cycles, and which of them it takes for a time."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from daemon.diagnosis import moment_plot
from daemon.diagnosis.moment import Moment, chosen, first_change
from daemon.diagnosis.moment_report import report
from daemon.health.reasons import Reason
from daemon.snapshot import LightFix, LightLink, LightPicture, LinkUse, Snapshot, State, Trust
from estimator.mapping.occupancy_grid import Grid
from estimator.result import Reason as MatchReason

NOTHING = Snapshot(1, 1.0, 1.0, 0.0, State.DEGRADED, Reason.NONE)
AGREED = Moment(0.0, State.DEGRADED, NOTHING, None, None, True, None, 0, ())
CYCLES = [replace(AGREED, utc=at) for at in (4.9, 5.123457, 5.2, 6.3, 6.6)]


@pytest.mark.parametrize(
    ("utc", "wide", "cycle"),
    [(5.123, 0.001, 1), (5.12, 0.01, 1), (5.1, 0.1, 1), (5.124, 0.001, 1), (5.122, 0.001, 0)],
)
def test_a_time_is_as_wide_as_its_last_digit(utc: float, wide: float, cycle: int) -> None:
    assert chosen(CYCLES, utc, second=False, wide=wide) == (cycle, cycle, None)


@pytest.mark.parametrize("after_s", [0.04, 0.3])
def test_a_fault_that_is_published_a_moment_after_the_second_of_the_journal_is_shown(after_s: float) -> None:
    """A heartbeat logs it, the next cycle publishes it: soon, or, of a slow lidar, whenever it comes."""
    late = replace(AGREED, utc=6.0 + after_s, faults=(101,))
    told = [*CYCLES[:3], late]
    said = report(told, 5.0, "here", 1.0, second=True)
    assert f"no change of state, reason or faults in it; a change {after_s:.2f} s after it, cycle of " in said
    assert "\nfault 101 since " in said
    assert "fault 101 comes" in said
    assert first_change([*told[:3], replace(AGREED, utc=6.01), replace(late, utc=6.3)], 5.0, 1.0) is None, "too late"
    sooner = [*told[:2], replace(told[2], state=State.LOST), replace(late, state=State.LOST)]
    said = report(sooner, 5.0, "here", 1.0, second=True)
    assert "first change of state, reason or faults in it" in said
    assert "fault 101 comes" in said


def test_of_a_second_in_which_nothing_changes_its_first_cycle_is_told() -> None:
    assert chosen(CYCLES, 5.0, second=True, wide=1.0).cycle == 1
    assert chosen(CYCLES, 6.35, second=True, wide=1.0).cycle == 4
    assert chosen(CYCLES, 7.0, second=True, wide=1.0).cycle == 4, "without a cycle"


@pytest.mark.parametrize(("against", "word"), [(0, "agrees"), (1, "agrees"), (3, "DISAGREES")])
def test_lamps_that_do_not_fit_the_place_dissent_though_what_is_left_agrees(against: int, word: str) -> None:
    links = tuple(LightLink(k, k, LinkUse.REJECTED if k < against else LinkUse.ACCEPTED, 1e-9, 0.5) for k in range(5))
    picture = LightPicture(LightFix.GOOD, 5 - against, 1.0, (1.0, 2.0, 0.0), links=links)
    shown = replace(NOTHING, pose=(1.0, 2.02, 0.0), light=picture, trust=Trust(0.3, gap=0.04, laser=True, wheels=True))
    moment = Moment(0.0, State.DEGRADED, shown, None, None, True, None, 0, ())
    said = report([moment], 0.0, "here", 0.1)
    line = next(line for line in said.splitlines() if line.startswith("  light "))
    assert f"light    {word}: its position is 0.02 m" in line
    assert (f"{against} are inconsistent with the pose" in line) is (against > 0)
    assert "fits again" not in said
    assert "protection level 0.30 m by lidar, odometry" in said


@pytest.mark.filterwarnings("error")
def test_a_picture_of_nothing_says_so_in_place_of_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    said: list[str] = []
    monkeypatch.setattr(moment_plot, "_empty", lambda _, why: said.append(why))
    shown = replace(NOTHING, light=LightPicture())
    moment = Moment(0.0, State.DEGRADED, shown, None, None, True, None, 0, ())
    assert moment_plot.draw([moment], 0.0, Grid(np.zeros(2), 0.05, np.zeros((0, 0), np.float32)))
    assert said == [
        "no sigma and no protection level was published",
        "odometry and lidar could not be compared",
        "no light solution was available",
    ]


def test_where_the_replay_says_something_else_that_is_said_in_a_line() -> None:
    shown = replace(NOTHING, state=State.NO_LIDAR, reason=Reason.LIDAR_SILENT)
    moment = Moment(0.0, State.NO_LIDAR, shown, None, None, True, None, 0, (), told=Reason.LIDAR_UNREACHABLE)
    said = report([moment], 0.0, "here", 0.1).splitlines()
    assert ": reason 3, the lidar cannot be opened" in said[1]
    assert said[2].startswith("(this was published; the replay gives NO_LIDAR: reason 4, no valid scan")
    assert not any("the replay" in line for line in said[3:])
    alike = replace(moment, told=Reason.LIDAR_SILENT)
    assert "the replay" not in report([alike], 0.0, "here", 0.1)
    newer = report([replace(moment, told=999, faults=(101,))], 0.0, "here", 0.1)
    assert "(newer software published reason 999, which is unknown here" in newer
    assert "has no published reason and faults" not in newer


@pytest.mark.parametrize(
    "other", [{"told": Reason.LIDAR_UNREACHABLE}, {"faults": (101,)}, {"faults": (101, 999)}, {"state": State.LOST}]
)
def test_the_first_change_of_a_second_is_that_of_what_was_published(other: dict[str, Any]) -> None:
    """The gravest fault may stay what it is, while another one comes; 999 is one of newer software."""
    before = Moment(0.0, State.NO_LIDAR, NOTHING, None, None, True, None, 0, (), told=Reason.LIDAR_SILENT)
    told = [before, replace(before, utc=5.25, **other), replace(before, utc=5.5, **other)]
    assert first_change(told, 5.0, 1.0) == 1
    assert first_change(told, 6.0, 1.0) is None
    changed = report(told, 5.0, "here", 1.0, second=True)
    assert "cycle of" in changed.splitlines()[0]
    for fault in other.get("faults", ()):
        assert f"fault {fault} comes: " in changed


def test_what_lamps_do_meanwhile_hides_no_fault() -> None:
    def lit(use: LinkUse) -> Snapshot:
        return replace(NOTHING, light=LightPicture(links=(LightLink(7, 7, use, 1e-9, 0.1),)))

    uses = [(LinkUse.ACCEPTED, LinkUse.OCCLUDED)[k % 2] for k in range(40)]
    moments = [
        Moment(0.1 * k, State.DEGRADED, lit(use), None, None, True, None, 0, (), Reason.NONE, (101,) if k > 3 else ())
        for k, use in enumerate(uses)
    ]
    changes = report(moments, 3.95, "here", 0.1).partition("what changed")[2].splitlines()[1:]
    assert changes[0] == "  ... 28 more, of axes, solutions, lamps"
    assert "fault 101 comes: no lidar is found" in changes[1]
    assert len(changes) == 13
    assert "lamp 7: ACCEPTED -> OCCLUDED" in changes[-1]


def test_a_moment_without_a_cycle_is_said_to_have_none() -> None:
    moment = Moment(100.0, State.DEGRADED, NOTHING, None, None, True, None, 0, ())
    for second, wide in ((False, 0.1), (True, 1.0)):
        head = report([moment], 50.0, "here", wide, second).splitlines()[0]
        assert "before the first cycle, which ran 50 s later, cycle of" in head
        assert "no change of" not in head
        head = report([moment, replace(moment, utc=200.0)], 195.0, "here", wide, second).splitlines()[0]
        assert "without a cycle; the last one before ran 95 s earlier, cycle of" in head
    assert "no cycle" not in report([moment], 100.5, "here", 0.1).splitlines()[0]


def test_a_lamp_that_was_hidden_and_fits_again_is_said_to_wait() -> None:
    links = (LightLink(7, 7, LinkUse.OCCLUDED, 1e-9, 0.1), LightLink(8, 8, LinkUse.OCCLUDED, 1e-9, -0.9))
    shown = replace(NOTHING, pose=(1.0, 2.0, 0.0), light=LightPicture(links=links))
    said = report([Moment(0.0, State.DEGRADED, shown, None, None, True, None, 0, ())], 0.0, "here", 0.1)
    assert "lamp 7 (1.11 of expected; consistent again, used if this continues), lamp 8 (0.41 of expected)" in said


@pytest.mark.parametrize(
    ("ok", "published", "ago", "word"),
    [
        (True, {}, 0.2, "matches: 9 of 10"),
        (True, {"state": State.NO_LIDAR}, 0.31, "no data for 0.31 s; before: 9 of 10"),
        (False, {"state": State.NO_LIDAR}, 0.31, "no data for 0.31 s; before: a scan without a match"),
        (True, {"told": Reason.LIDAR_SILENT}, 0.31, "no data for 0.31 s; before: 9 of 10"),
        (True, {"state": State.NO_LIDAR}, 0.0, "matches again, not steady yet: 9 of 10"),
        (False, {}, 0.0, "DISAGREES: a scan without a match"),
    ],
)
def test_what_is_said_of_the_laser_agrees_with_what_was_published(
    ok: bool, published: dict[str, Any], ago: float, word: str
) -> None:
    """A gap of three scan periods is NO_LIDAR, however short that is."""
    why = MatchReason.CONVERGED if ok else MatchReason.REJECTED
    match = SimpleNamespace(
        ok=ok, reason=why, queries=10, inliers=9, residual_m=0.006, correction=np.zeros(3), blind_directions=lambda: ()
    )
    result: Any = SimpleNamespace(match=match)
    shown = replace(NOTHING, lidar_ok=not (published and ago))
    told = [replace(AGREED, result=result, scan=7), replace(AGREED, utc=ago, snapshot=shown, **published)]
    told = told if ago else [replace(told[0], snapshot=shown, **published)]
    line = next(line for line in report(told, ago, "here", 0.1).splitlines() if line.startswith("  lidar "))
    assert line.startswith(f"  lidar    {word}")


def laser_of(told: list[Moment]) -> str:
    return next(line for line in report(told, told[-1].utc, "here", 0.1).splitlines() if line.startswith("  lidar "))


def scanned(**change: Any) -> Moment:
    """A cycle with a scan of its own, which fits."""
    match = SimpleNamespace(
        ok=True, queries=10, inliers=9, residual_m=0.006, correction=np.zeros(3), blind_directions=lambda: ()
    )
    result: Any = SimpleNamespace(match=match)
    return replace(AGREED, result=result, scan=7, **change)


@pytest.mark.parametrize(
    ("lidar_ok", "word"), [(True, "matches, 0.60 s ago: 9 of 10"), (False, "no data for 0.60 s; before: 9 of 10")]
)
def test_how_long_a_slow_laser_may_be_silent_is_the_daemons_to_say(lidar_ok: bool, word: str) -> None:
    later = replace(AGREED, utc=0.6, state=State.TRACKING, snapshot=replace(NOTHING, lidar_ok=lidar_ok))
    assert laser_of([scanned(), later]).startswith(f"  lidar    {word}")


def test_a_laser_that_has_just_spoken_is_not_silent_though_it_is_not_steady_yet() -> None:
    """Also where another sensor holds the pose meanwhile, so that the state is not NO_LIDAR."""
    unsteady = replace(NOTHING, lidar_ok=False)
    assert laser_of([scanned(snapshot=unsteady)]).startswith("  lidar    matches: 9 of 10")
    for reason in (Reason.LIDAR_SILENT, Reason.LIDAR_UNREACHABLE):
        line = laser_of([scanned(snapshot=unsteady, told=reason)])
        assert line.startswith("  lidar    matches again, not steady yet: 9 of 10")


def test_changes_are_told_of_the_twenty_seconds_before_the_second() -> None:
    told = [replace(AGREED, utc=-14.98), replace(AGREED, utc=5.95, faults=(101,))]
    assert "what changed in the 20 s before and in this second" in report(told, 5.0, "here", 1.0, second=True)
