"""A computer that becomes too slow and quick again: what is left out, what is said, and that it all comes back."""

from __future__ import annotations

import pytest

from daemon.health.reasons import Reason
from daemon.runtime.budget import MeasuredBudget, RecordedBudget
from daemon.runtime.worker import ScheduledWorker
from daemon.snapshot import State
from estimator.measurements import DegradationLevel
from tests.daemon.runtime.test_cycle import Bench, on_bench
from tests.daemon.support.room import error

pytestmark = pytest.mark.jit


class Speed:
    """A stopwatch by which every lap takes ``lap_s``."""

    def __init__(self) -> None:
        self.lap_s = 0.001
        self.now = 0.0

    def __call__(self) -> float:
        self.now += self.lap_s
        return self.now


def slow_for_a_while(odometry: bool) -> Bench:
    """Six seconds quick, eight slow, and quick again."""
    speed = Speed()

    async def drive(bench: Bench) -> None:
        await bench.drive(0, 60, odometry)
        speed.lap_s = 0.040
        await bench.drive(60, 80, odometry)
        speed.lap_s = 0.001
        await bench.drive(140, 200, odometry)

    return on_bench(drive, odometry=odometry, stopwatch=speed, budget=MeasuredBudget())


def test_where_odometry_carries_the_pose_the_laser_is_left_out_and_that_is_said() -> None:
    bench = slow_for_a_while(odometry=True)
    slow = bench.snapshots[80:138]
    assert {(s.state, s.reason) for s in slow} == {(State.DEGRADED, Reason.OVERLOADED)}, "trials between do not flicker"
    carried = [r.limits for r in bench.records if r.limits is not None and r.limits.level == DegradationLevel.CARRIED]
    assert len(carried) > 50
    last = bench.snapshots[-1]
    assert last.state is State.TRACKING
    assert last.pulse is not None
    assert last.pulse.rung == 0
    assert last.pulse.carried == len(carried)
    assert max(error(s.pose, s.t_mono)[0] for s in bench.snapshots[-50:] if s.pose is not None) < 0.02
    assert bench.cycle.timing.short >= len(carried)


def test_where_nothing_else_carries_the_pose_scans_go_on_being_matched() -> None:
    bench = slow_for_a_while(odometry=False)
    levels = {r.limits.level for r in bench.records if r.limits is not None}
    assert levels == {DegradationLevel.FULL, DegradationLevel.THINNED, DegradationLevel.NO_MAP}
    matched = [r.result.match for r in bench.records[80:138] if r.result is not None]
    assert all(match is not None and match.ok for match in matched)
    assert bench.snapshots[-1].state is State.TRACKING


def test_a_replay_under_the_recorded_caps_says_the_same() -> None:
    first = slow_for_a_while(odometry=True)
    caps = RecordedBudget([r.limits for r in first.records if r.limits is not None])
    answers = ScheduledWorker({r.cycle: r.answers for r in first.records if r.answers})

    async def drive(bench: Bench) -> None:
        await bench.drive(0, 60, odometry=True)
        await bench.drive(60, 80, odometry=True)
        await bench.drive(140, 200, odometry=True)

    again = on_bench(drive, odometry=True, budget=caps, worker=answers)
    assert [(s.pose, s.state, s.reason) for s in again.snapshots] == [
        (s.pose, s.state, s.reason) for s in first.snapshots
    ]
