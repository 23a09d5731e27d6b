"""The state machine where scans are missing, for a moment or again and again."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from daemon.health.reasons import Reason
from daemon.integrity.evidence import SILENT_PERIODS, Evidence, Match
from daemon.integrity.state_machine import judge
from daemon.integrity.state_memory import AGAIN_S, FAILED_SCANS, Memory
from daemon.snapshot import State
from tests.daemon.integrity.judged_steps import ALL, BAD, PERIOD, run, said, scans, seen, tracking

NEAR = Match(True, ALL, 0.02, 0.01)
FAR = Match(True, ALL, 0.5, 0.01)


def gap(begin: float, seconds: float, **more: object) -> list[Evidence]:
    """A silence of the laser, with the cycles that go on through it."""
    evidence = [Evidence(begin + PERIOD * i, silence=3.0 + i, mapped=True) for i in range(round(seconds / PERIOD))]
    return [replace(item, **more) for item in evidence]  # type: ignore[arg-type]  # test shorthand


@pytest.mark.parametrize(("seconds", "odometry"), [(1.0, None), (20.0, None), (300.0, True)])
def test_a_pose_that_is_found_where_it_was_left_is_tracked_within_a_second(seconds: float, odometry: bool) -> None:
    silent = run(tracking(odometry=odometry), gap(3.0, seconds, odometry=odometry))
    assert silent.state is State.NO_LIDAR
    back = [*scans(3.0 + seconds, 1, NEAR, odometry=odometry), *scans(3.1 + seconds, 9, odometry=odometry)]
    assert run(silent, back[:5]).state is not State.TRACKING, "a few scans are no proof"
    assert run(silent, back).state is State.TRACKING


def test_a_pose_that_is_found_elsewhere_or_was_never_proved_takes_as_long_as_ever() -> None:
    silent = run(tracking(), gap(3.0, 10.0))
    moved = [*scans(13.0, 1, FAR), *scans(13.1, 40)]
    assert run(silent, moved).state is State.MAPPING
    young = run(Memory(), scans(0.0, 5))
    assert young.state is State.MAPPING
    assert run(run(young, gap(0.5, 1.0)), scans(1.5, 10, NEAR)).state is State.MAPPING
    long = run(tracking(), gap(3.0, 90.0))
    assert run(long, scans(93.0, 40, NEAR)).state is State.MAPPING, "nobody has watched it for a minute and a half"


def test_a_laser_that_comes_and_goes_does_not_forget_what_was_proved() -> None:
    memory, t = tracking(odometry=True), 3.0
    for _ in range(5):
        memory = run(memory, [*gap(t, 1.0, odometry=True), *scans(t + 1.0, 3, NEAR, odometry=True)])
        t += 1.3
    assert run(memory, scans(t, 7, NEAR, odometry=True)).state is State.TRACKING
    failing = run(memory, scans(t, FAILED_SCANS, BAD, odometry=True))
    assert not failing.sure
    assert not failing.recalled


def lossy(begin: float, period: float, loss: float, seed: int) -> list[Evidence]:
    """Six seconds of a laser whose scans get lost by chance; without one there is a cycle after 1.5 periods."""
    draw, last, cycle = Random(seed), begin, begin
    told: list[Evidence] = []
    for scan in range(1, round(6.0 / period) + 1):
        t = begin + scan * period
        while t - cycle > 1.5 * period + 1e-9:
            cycle += 1.5 * period
            told.append(seen(cycle, None, silence=(cycle - last) / period))
        if draw.random() >= loss:
            last = cycle = t
            told.append(seen(t, NEAR, silence=0.0))
    return told


@pytest.mark.parametrize("period", [0.025, 0.1])
@pytest.mark.parametrize("loss", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("seed", range(5))
def test_a_laser_that_loses_many_scans_does_not_take_the_state_along(period: float, loss: float, seed: int) -> None:
    memory = run(Memory(), [seen(period * i, NEAR) for i in range(round(4.0 / period))])
    assert memory.state is State.TRACKING
    changes = 0
    for evidence in lossy(4.0, period, loss, seed):
        before, memory = memory.state, judge(memory, evidence)
        changes += memory.state is not before
        if evidence.silence is not None and evidence.silence >= SILENT_PERIODS:
            assert memory.state is State.NO_LIDAR, "bad news counts at once"
    assert changes <= 12, "two a second"
    after = 0
    while memory.state is not State.TRACKING:
        after += 1
        memory = judge(memory, seen(10.0 + after * period, NEAR))
    assert after * period <= 1.0


@pytest.mark.parametrize("every", [12, 15, 20, 30])
def test_a_laser_that_goes_on_coming_and_going_is_trusted_later_and_after_a_calm_time_as_ever(every: int) -> None:
    """A loose plug: 0.45 s without scans, again and again for a minute."""
    memory, last, changed = tracking(), 3.0, []
    for i in range(600):
        t = 3.0 + PERIOD * i
        gone = i % every < 5
        last = last if gone else t
        before, memory = memory.state, judge(memory, seen(t, None if gone else NEAR, silence=(t - last) / PERIOD))
        if memory.state is not before:
            changed.append(i)
        if t - last > SILENT_PERIODS * PERIOD:
            assert memory.state is State.NO_LIDAR, "bad news counts at once"
    assert len(changed) <= 14
    assert changed[-1] < 300, "the second half minute says one thing"
    back = run(memory, scans(63.0, 34, NEAR))
    assert back.state is State.TRACKING
    calm = run(back, [*scans(66.4, 31, NEAR), *gap(69.5, 1.0)])
    assert calm.state is State.NO_LIDAR
    assert run(calm, scans(70.5, 10, NEAR)).state is State.TRACKING
    assert judge(calm, seen(70.5, NEAR)).state is not State.NO_LIDAR, "it is a single gap again"


def test_a_single_gap_is_over_with_the_first_scan() -> None:
    memory = run(tracking(), gap(3.0, 2.0))
    assert memory.state is State.NO_LIDAR
    assert judge(memory, seen(5.0, NEAR)).state is not State.NO_LIDAR
    again = run(memory, [*scans(5.0, 10, NEAR), *gap(6.0, 1.0)])
    assert judge(again, seen(7.0, NEAR)).state is State.NO_LIDAR
    assert run(again, scans(7.0, 10, NEAR)).state is State.TRACKING
    later = run(again, [*scans(7.0, 10 + round(10.0 * AGAIN_S), NEAR), *gap(8.0 + AGAIN_S, 1.0)])
    assert judge(later, seen(9.0 + AGAIN_S, NEAR)).state is not State.NO_LIDAR


def test_after_the_start_a_pose_that_is_found_where_the_run_before_has_left_it_is_tracked_at_once() -> None:
    looking = run(Memory(), scans(0.0, 10, places=0))
    assert said(looking) == (State.RELOCATING, Reason.SEARCHING)
    found = run(judge(looking, seen(1.0, recalled=True)), scans(1.1, 8))
    assert found.state is State.TRACKING
    assert not found.doubt
    assert run(judge(looking, seen(1.0)), scans(1.1, 40)).state is State.MAPPING, (
        "without a memory it takes five seconds"
    )
