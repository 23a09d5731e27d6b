"""PAUSE and RESUME: the laser moves nothing, the map is not touched, and it all goes on afterwards, repeatably."""

from __future__ import annotations

import pytest

from daemon.integrity.state_memory import Memory
from daemon.runtime.budget import RecordedBudget
from daemon.runtime.worker import ScheduledWorker
from daemon.snapshot import State
from estimator.measurements import Command, DegradationLevel, Order
from estimator.result import Reason
from tests.daemon.runtime.test_cycle import Bench, on_bench

pytestmark = pytest.mark.jit


async def paused_in_the_middle(bench: Bench) -> None:
    await bench.drive(0, 30, odometry=True)
    bench.cycle.inbox.put_command(Command(3.0, Order.PAUSE))
    await bench.drive(30, 30, odometry=True)
    bench.cycle.inbox.put_command(Command(6.0, Order.RESUME))
    await bench.drive(60, 40, odometry=True)


def test_the_map_is_left_alone_and_the_laser_moves_nothing() -> None:
    bench = on_bench(paused_in_the_middle, odometry=True)
    begun = next(k for k, record in enumerate(bench.records) if record.commands)
    ended = next(k for k, record in enumerate(bench.records) if k > begun and record.commands)
    during = bench.records[begun:ended]
    assert len(during) >= 25
    assert all(
        r.limits is not None and r.limits.level == DegradationLevel.CARRIED and not r.limits.update_map for r in during
    )
    assert all(r.result is not None and r.result.keyframe < 0 and not r.answers for r in during)
    seen = {r.result.match.reason for r in during if r.result is not None and r.result.match is not None}
    assert seen == {Reason.PASSED_OVER}
    after = bench.records[-1].result
    assert after is not None
    assert after.match is not None
    assert after.match.ok
    asked = [order for records, _ in bench.estimate.calls for order in records if isinstance(order, Command)]
    assert asked == [], "the estimator is not concerned"
    assert any(r.result is not None and r.result.keyframe >= 0 for r in bench.records[ended:])


def test_a_pose_that_is_lost_during_a_pause_is_no_laser_at_odds_with_the_map() -> None:
    """No scan has been compared with anything: without wheels the pose has only become too uncertain."""
    misfits: list[bool] = []
    compared: list[bool] = []

    async def paused_and_driven(bench: Bench) -> None:
        on_verdict = bench.cycle.watch.on_verdict

        def listen(t_mono: float, memory: Memory, scans: bool) -> None:
            compared.append(scans)
            on_verdict(t_mono, memory, scans)

        bench.cycle.watch.on_verdict = listen  # type: ignore[method-assign]  # to see what it is told
        await bench.drive(0, 60)
        bench.cycle.inbox.put_command(Command(6.0, Order.PAUSE))
        for begin in range(60, 240, 20):
            await bench.drive(begin, 20)
            misfits.append(bench.cycle.watch.misfit)

    states = [snapshot.state for snapshot in on_bench(paused_and_driven).snapshots]
    assert State.TRACKING in states
    assert states[-30:] == [State.LOST] * 30
    assert not any(misfits)
    assert all(compared[1:55])
    assert not any(compared[65:])


def test_answers_that_came_during_a_pause_are_applied_after_it_and_a_replay_repeats_that() -> None:
    bench = on_bench(paused_in_the_middle, odometry=True)
    applied = {r.cycle: r.answers for r in bench.records if r.answers}
    asked = [job.job_id for r in bench.records if r.result is not None for job in r.result.jobs]
    assert len(sum(applied.values(), ())) >= len(asked) - 2

    budget = RecordedBudget([r.limits for r in bench.records if r.limits is not None])
    replay = on_bench(paused_in_the_middle, odometry=True, budget=budget, worker=ScheduledWorker(applied))
    assert [(s.pose, s.state) for s in replay.snapshots] == [(s.pose, s.state) for s in bench.snapshots]
