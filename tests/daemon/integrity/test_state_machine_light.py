"""The state machine with lights: what is said when they agree, contradict, fall silent, or hold the pose alone."""

from __future__ import annotations

from dataclasses import replace

from daemon.health.reasons import Reason
from daemon.integrity.evidence import Evidence, Light
from daemon.integrity.state_machine import judge
from daemon.integrity.state_memory import DARK_S, Memory
from daemon.snapshot import State
from tests.daemon.integrity.judged_steps import ALL, BAD, LIT, PERIOD, run, said, scans, seen


def lit(count: int = 40, light: Light = LIT, **more: object) -> Memory:
    """After some scans that light agrees with."""
    return run(Memory(), scans(0.0, count, light=light, **more))


def test_light_and_laser_that_agree_about_the_place_are_believed() -> None:
    assert said(lit()) == (State.TRACKING, Reason.NONE)
    assert lit(15).state is State.TRACKING
    assert lit(8).state is State.MAPPING


def test_light_that_proves_anew_the_place_that_is_held_is_not_dark() -> None:
    """People have hidden the lamps: light looks for its place again, and finds it where the pose is held."""
    looking = replace(LIT, used=False, fits=True)
    assert run(lit(), scans(4.0, 80, light=looking)).state is State.TRACKING
    assert said(run(lit(), scans(4.0, 80, light=replace(looking, fits=False)))) == (State.DEGRADED, Reason.LIGHT_DARK)
    moved = run(lit(), scans(4.0, 10, light=replace(LIT, agrees=False)))
    moved = run(moved, scans(5.0, 1, light=replace(LIT, moved=True)))
    assert said(run(moved, scans(5.1, 80, light=looking))) == (State.DEGRADED, Reason.LIGHT_DARK)


def test_before_light_has_told_where_the_map_lies_nothing_is_tracked() -> None:
    unplaced = Light(alive=True)
    assert said(lit(light=unplaced)) == (State.MAPPING, Reason.UNPLACED)
    young = replace(LIT, known=(True, True, False))
    assert said(lit(light=young, sigma_rad=1.8)) == (State.RELOCATING, Reason.UNPLACED)


def test_a_pose_that_light_contradicts_is_not_tracked() -> None:
    odd = replace(LIT, agrees=False)
    memory = run(lit(), scans(4.0, 2, light=odd))
    assert memory.state is State.TRACKING
    memory = run(memory, scans(4.2, 3, light=odd))
    assert said(memory) == (State.DEGRADED, Reason.LIGHT_DISAGREES)
    assert run(memory, scans(4.5, 20, light=LIT)).state is State.TRACKING


def test_lamps_that_cannot_be_received_here_end_tracking_at_once() -> None:
    odd = replace(LIT, used=False, agrees=False)
    assert run(lit(), [seen(4.0, light=odd)]).state is State.TRACKING
    assert said(run(lit(), [seen(4.0, light=replace(odd, elsewhere=True))])) == (State.DEGRADED, Reason.LIGHT_DISAGREES)


def test_tracking_is_not_begun_while_pose_and_light_are_apart_and_goes_on() -> None:
    apart = replace(LIT, apart=True)
    assert said(lit(80, light=apart)) == (State.MAPPING, Reason.UNPROVED)
    assert run(lit(80, light=apart), scans(8.0, 9, light=LIT)).state is State.MAPPING, "one epoch that fits is none"
    assert said(run(lit(80, light=apart), scans(8.0, 11, light=LIT))) == (State.TRACKING, Reason.NONE)
    assert run(lit(), scans(4.0, 80, light=apart)).state is State.TRACKING
    vague = lit(sigma_rad=0.1)
    assert said(run(vague, scans(4.0, 80, light=apart))) == (State.DEGRADED, Reason.CONFIRMING)


def test_tracking_of_a_place_that_was_tracked_before_waits_for_nobody() -> None:
    apart = replace(LIT, apart=True)
    for broken in ({"sigma_rad": 0.1}, {"silence": 5.0, "match": None}):
        assert run(run(lit(), scans(4.0, 9, light=LIT, **broken)), scans(4.9, 80, light=apart)).state is State.TRACKING
    doubted = run(lit(), scans(4.0, 10, light=replace(LIT, agrees=False)))
    doubted = run(doubted, scans(5.0, 1, light=replace(LIT, moved=True)))
    assert run(doubted, scans(5.1, 80, light=LIT)).state is State.TRACKING
    assert run(doubted, scans(5.1, 80, light=apart)).state is State.DEGRADED, "another place, to be proved anew"


def test_after_light_has_moved_the_pose_the_place_is_proved_for_longer() -> None:
    memory = run(lit(), scans(4.0, 10, light=replace(LIT, agrees=False)))
    memory = run(memory, scans(5.0, 1, light=replace(LIT, moved=True)))
    assert memory.doubt
    assert run(memory, scans(5.1, 45, light=LIT)).state is State.DEGRADED
    assert run(memory, scans(5.1, 60, light=LIT)).state is State.TRACKING


def test_a_light_that_has_given_its_place_up_takes_the_state_with_it() -> None:
    gone = replace(LIT, used=False, lost=True, agrees=None)
    memory = run(lit(), scans(4.0, 3, light=gone))
    assert said(memory) == (State.DEGRADED, Reason.LIGHT_LOST)
    assert said(run(memory, scans(4.3, 3, BAD, light=gone, odometry=True))) == (State.RELOCATING, Reason.LIGHT_LOST)


def test_a_photodiode_that_falls_silent_degrades_at_once_and_darkness_after_a_while() -> None:
    silent = replace(LIT, alive=False, used=False, agrees=None)
    assert said(run(lit(), scans(4.0, 1, light=silent))) == (State.DEGRADED, Reason.LIGHT_SILENT)
    dark = replace(LIT, used=False, agrees=None)
    soon = run(lit(), scans(4.0, round((DARK_S - 0.3) / PERIOD), light=dark))
    assert soon.state is State.TRACKING
    late = run(soon, scans(4.0 + DARK_S, 3, light=dark))
    assert said(late) == (State.DEGRADED, Reason.LIGHT_DARK)
    assert run(late, scans(10.0, 3, light=LIT)).state is State.TRACKING


def quiet(t: float, light: Light = LIT, **more: object) -> Evidence:
    """A cycle without a laser."""
    return replace(Evidence(t, silence=5.0, mapped=True, light=light), **more)  # type: ignore[arg-type]  # as above


def test_light_holds_the_pose_while_the_laser_is_silent() -> None:
    memory = run(lit(), [quiet(4.0 + PERIOD * i) for i in range(50)])
    assert said(memory) == (State.DEGRADED, Reason.LIDAR_SILENT)
    assert memory.known == ALL
    assert not memory.doubt
    assert run(memory, scans(9.0, 15, light=LIT)).state is State.TRACKING
    dark = replace(LIT, used=False, agrees=None)
    assert said(run(memory, [quiet(9.0 + PERIOD * i, dark) for i in range(15)])) == (State.LOST, Reason.NO_WITNESS)
    bridged = run(memory, [quiet(9.0 + PERIOD * i, dark, odometry=True) for i in range(15)])
    assert said(bridged) == (State.DEGRADED, Reason.LIDAR_SILENT)
    assert said(judge(memory, quiet(9.1, sigma_m=2.0, light=replace(LIT, agrees=None)))) == (
        State.LOST,
        Reason.UNCERTAIN,
    )


def test_light_alone_tracks_when_there_is_no_laser_to_wait_for() -> None:
    def alone(begin: float, count: int, light: Light = LIT, **more: object) -> list[Evidence]:
        return [quiet(begin + PERIOD * i, light, silence=None, lidar=False, **more) for i in range(count)]

    assert said(run(Memory(), alone(0.0, 5, Light(alive=True)))) == (State.RELOCATING, Reason.UNPLACED)
    assert said(run(Memory(), alone(0.0, 5, Light(alive=False)))) == (State.LOST, Reason.LIGHT_SILENT)
    assert said(run(Memory(), alone(0.0, 5, Light(alive=True), places=2))) == (State.AMBIGUOUS, Reason.SEVERAL_PLACES)
    memory = run(Memory(), alone(0.0, 25, odometry=True))
    assert said(memory) == (State.TRACKING, Reason.NONE)
    apart = run(Memory(), alone(0.0, 25, replace(LIT, apart=True), odometry=True))
    assert said(apart) == (State.DEGRADED, Reason.CONFIRMING)
    assert said(run(apart, alone(2.5, 11, odometry=True))) == (State.TRACKING, Reason.NONE)
    vague = replace(LIT, known=(True, False, True))
    assert said(run(memory, alone(3.0, 3, vague, odometry=True))) == (State.DEGRADED, Reason.UNCERTAIN)
    assert said(run(memory, alone(3.0, 3, odometry=False))) == (State.DEGRADED, Reason.ODOMETRY_SILENT)
    lost = replace(LIT, lost=True, used=False, agrees=None)
    assert said(run(memory, alone(3.0, 3, lost, odometry=True))) == (State.RELOCATING, Reason.LIGHT_LOST)
