"""The cycle under virtual time: a pose that follows the room, when cycles start, what is kept, dropped and repeated."""

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from daemon.config.schema import LidarConfig
from daemon.devices.conversion import ScanBridge
from daemon.health.reasons import Reason
from daemon.runtime.budget import Budget, FixedBudget, MeasuredBudget, RecordedBudget
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import CycleRecord, Parts
from daemon.runtime.scheduler import Pacemaker
from daemon.runtime.stage_times import StageTimer
from daemon.runtime.worker import CycleWorker, ScheduledWorker, Worker
from daemon.snapshot import Snapshot, State
from estimator import pipeline
from estimator.measurements import Command, Job, Limits, Order, Record
from estimator.result import StepResult
from hal.clock import LoopClock, run_virtual
from hal.lidar import LidarStatus, Link, RawScan
from tests.daemon.support.room import error, raw_odometry, raw_scan, rest

PERIOD = 0.1


class Estimate:
    """The real estimator; notes what it was given, and asks for a job whenever a keyframe is laid."""

    def __init__(self) -> None:
        self.state = pipeline.new_state()
        self.calls: list[tuple[tuple[Record, ...], Limits]] = []

    def __call__(self, records: tuple[Record, ...], limits: Limits) -> StepResult:
        self.calls.append((records, limits))
        result = pipeline.step(self.state, records, limits)
        key = result.keyframe
        return replace(result, jobs=(Job(key, 0, lambda: key),)) if key >= 0 else result


@dataclass
class Bench:
    """A cycle in virtual time with everything it published and decided."""

    budget: Budget = field(default_factory=FixedBudget)
    worker: Worker = field(default_factory=CycleWorker)
    stopwatch: Callable[[], float] | None = None
    odometry: bool = False
    status: LidarStatus = field(default_factory=lambda: LidarStatus(link=Link.STREAMING))
    estimate: Estimate = field(default_factory=Estimate)
    records: list[CycleRecord] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    budget_us: float = 0.0

    def __post_init__(self) -> None:
        parts = Parts(
            clock=LoopClock(asyncio.get_running_loop(), utc_at_zero=1e9),
            step=self.estimate,
            scans=ScanBridge(LidarConfig()),
            budget=self.budget,
            worker=self.worker,
            status=self.status,
            odometry=self.odometry,
            budget_us=self.budget_us,
            timer=StageTimer(self.stopwatch),
            sinks=[self.snapshots.append],
            tap=self.records.append,
        )
        self.cycle = Cycle(parts)
        self.pacemaker = Pacemaker(self.cycle)

    async def drive(self, begin: int, count: int, odometry: bool = False) -> None:
        """Deliver scans ``begin`` to ``begin + count`` when they are complete, odometry at 20 Hz in between."""
        loop = asyncio.get_running_loop()
        for seq in range(begin, begin + count):
            scan = raw_scan(seq, seq * PERIOD)
            for half in (0.0, 0.5) if odometry else ():
                t = (seq + half) * PERIOD
                await asyncio.sleep(max(0.0, t - loop.time()))
                self.cycle.inbox.put_odometry(raw_odometry(t))
            await asyncio.sleep(max(0.0, scan.t_rx - loop.time()))
            self.pacemaker.on_scan(scan)
            await asyncio.sleep(0)  # the cycle has its turn


def on_bench(work: Callable[[Bench], object], **options: object) -> Bench:
    """Run a piece of work beside the pacemaker in virtual time; returns the bench as it was left."""

    async def go() -> Bench:
        bench = Bench(**options)  # type: ignore[arg-type]  # test shorthand
        beating = asyncio.create_task(bench.pacemaker.run())
        await asyncio.sleep(0)
        await work(bench)  # type: ignore[misc]  # test shorthand
        await asyncio.sleep(0.01)
        beating.cancel()
        return bench

    return run_virtual(go())


@pytest.mark.parametrize("odometry", [False, True])
def test_the_pose_follows_the_room_and_becomes_tracking(odometry: bool) -> None:
    bench = on_bench(lambda b: b.drive(0, 100, odometry), odometry=odometry)
    with_scan = [record for record in bench.records if record.scan is not None]
    assert [record.scan for record in with_scan] == list(range(100))
    assert bench.snapshots[-1].state is State.TRACKING
    for record in with_scan[1:]:
        pose = record.snapshot.pose
        assert pose is not None
        off_m, off_rad = error(pose, record.snapshot.t_mono)
        assert off_m < 0.02
        assert off_rad < 0.01


def test_the_pose_is_published_with_its_age_and_carried_to_now() -> None:
    bench = on_bench(lambda b: b.drive(0, 60))
    last = next(record for record in bench.records if record.scan == 59).snapshot
    assert last.t_sent - last.t_mono == pytest.approx(0.002, abs=2e-3)
    assert last.t_utc == pytest.approx(1e9 + last.t_sent)
    idle = on_bench(lambda b: _drive_then(b, 60, 1.6 * PERIOD)).snapshots[-1]
    assert idle.predicted is not None
    assert idle.t_sent - idle.t_mono > 1.4 * PERIOD
    carried_m, _ = error(idle.predicted, idle.t_sent)
    held_m, _ = error(idle.pose or (9, 9, 9), idle.t_sent)
    assert carried_m < 0.5 * held_m


async def _drive_then(bench: Bench, count: int, wait: float) -> None:
    await bench.drive(0, count)
    await asyncio.sleep(wait)


def test_without_scans_a_cycle_starts_at_one_and_a_half_learned_periods() -> None:
    bench = on_bench(lambda b: _drive_then(b, 20, 1.0))
    begins = [record.t_mono for record in bench.records if record.t_mono > 19 * PERIOD]
    np.testing.assert_allclose(np.diff(begins), 1.5 * PERIOD, rtol=1e-6)
    assert bench.cycle.period.seconds == pytest.approx(PERIOD)


def test_silence_is_said_at_three_periods_and_what_was_known_is_not_known_any_more() -> None:
    bench = on_bench(lambda b: _drive_then(b, 40, 2.0))
    last_scan = 39 * PERIOD + 681 * PERIOD / 1024 + 0.002
    silent = next(s for s in bench.snapshots if s.state is State.NO_LIDAR)
    assert 2.9 * PERIOD < silent.t_sent - last_scan <= 3.1 * PERIOD
    assert silent.reason == Reason.LIDAR_SILENT
    assert (silent.known, silent.lidar_ok, silent.scan_rate) == ((False, False, False), False, 0.0)
    assert silent.pose is not None, "the pose is kept across the gap"
    assert bench.snapshots[-1].predicted is None, "an old velocity predicts nothing"


def test_the_pose_is_taken_up_again_after_a_gap_at_rest() -> None:
    async def gap(bench: Bench) -> None:
        await bench.drive(0, 9)  # at rest until 1 s
        await asyncio.sleep(0.5)
        loop = asyncio.get_running_loop()
        for i in range(40):
            t = loop.time()
            await asyncio.sleep(PERIOD)
            bench.pacemaker.on_scan(raw_scan(20 + i, t, rest))

    bench = on_bench(gap)
    states = [s.state for s in bench.snapshots]
    assert State.NO_LIDAR in states
    assert states[-1] is State.TRACKING
    assert bench.snapshots[-1].pose == pytest.approx((0, 0, 0), abs=5e-3)


def test_odometry_carries_the_pose_through_a_gap() -> None:
    async def gap(bench: Bench) -> None:
        await bench.drive(0, 60, odometry=True)
        loop = asyncio.get_running_loop()
        for _ in range(40):
            await asyncio.sleep(0.05)
            bench.cycle.inbox.put_odometry(raw_odometry(loop.time()))

    last = on_bench(gap, odometry=True).snapshots[-1]
    assert last.state is State.NO_LIDAR
    assert last.pose is not None
    assert error(last.pose, last.t_mono)[0] < 0.03
    assert last.t_sent - last.t_mono < 0.2, "odometry keeps the pose fresh"


def test_the_latest_scan_wins_and_the_dropped_ones_are_counted() -> None:
    async def burst(bench: Bench) -> None:
        await bench.drive(0, 5)
        for seq in (5, 6, 7):  # one read that held three frames
            bench.pacemaker.on_scan(raw_scan(seq, seq * PERIOD))
        await asyncio.sleep(0.01)

    bench = on_bench(burst)
    assert (bench.records[-1].scan, bench.records[-1].dropped) == (7, (5, 6))
    assert bench.snapshots[-1].missed == 2


def test_no_odometry_is_lost_when_cycles_are_late() -> None:
    async def flood(bench: Bench) -> None:
        await bench.drive(0, 5, odometry=True)
        for i in range(3000):  # a minute without a cycle: the loop is held up
            t = 0.5 + 0.02 * i
            bench.cycle.inbox.put_odometry(replace(raw_odometry(t), x=0.001 * i, y=0.0, yaw=0.0))
        bench.cycle.run()

    bench = on_bench(flood)
    record = bench.records[-1]
    assert record.odometry == 3010
    assert bench.snapshots[-1].odom is not None
    assert bench.snapshots[-1].odom[0] == pytest.approx(2.999, abs=0.02)


def test_odometry_that_jumps_is_no_witness_until_its_window_has_filled_again() -> None:
    async def jump(bench: Bench) -> None:
        await bench.drive(0, 50, odometry=True)
        assert bench.cycle.observer.motion_consistency.agree() is True
        for k in range(8):  # until it is certain that the sender has a new origin
            bench.cycle.inbox.put_odometry(replace(raw_odometry(4.96 + PERIOD * k), x=50.0))
            await asyncio.sleep(PERIOD)

    bench = on_bench(jump, odometry=True)
    assert bench.cycle.odometry.jumps == 1
    assert bench.cycle.observer.motion_consistency.agree() is None


def test_an_empty_cycle_makes_no_step() -> None:
    async def idle(bench: Bench) -> None:
        await asyncio.sleep(1.0)

    bench = on_bench(idle)
    assert bench.estimate.calls == []
    assert len(bench.records) == 6
    assert {record.limits for record in bench.records} == {None}
    assert bench.snapshots[-1].pose is None
    assert (bench.snapshots[-1].state, bench.snapshots[-1].lidar_ok) == (State.STARTING, False)


def test_a_driver_that_backs_off_is_said_to_be_unreachable_at_once_and_a_hanging_one_after_a_while() -> None:
    async def idle(bench: Bench) -> None:
        await asyncio.sleep(11.0)

    backing_off = on_bench(idle, status=LidarStatus(link=Link.WAITING)).snapshots
    assert (backing_off[0].state, backing_off[0].reason) == (State.NO_LIDAR, Reason.LIDAR_UNREACHABLE)
    hanging = on_bench(idle, status=LidarStatus(link=Link.OPENING)).snapshots
    assert hanging[0].state is State.STARTING
    assert hanging[-1].reason == Reason.LIDAR_UNREACHABLE


def test_commands_reach_the_estimator_and_a_reset_is_another_map() -> None:
    async def order(bench: Bench) -> None:
        await bench.drive(0, 10)
        bench.cycle.inbox.put_command(Command(1.0, Order.SET_POSE, np.array((5.0, 6.0, 1.0))))
        await bench.drive(10, 5)
        bench.cycle.inbox.put_command(Command(1.5, Order.RESET))
        await bench.drive(15, 5)

    bench = on_bench(order)
    by_scan = {record.scan: record for record in bench.records if record.scan is not None}
    assert by_scan[10].snapshot.pose == pytest.approx((5.0, 6.0, 1.0), abs=0.02)
    assert [len(by_scan[n].commands) for n in (9, 10, 11, 15)] == [0, 1, 0, 1]
    assert by_scan[15].snapshot.map_id not in (0, by_scan[14].snapshot.map_id)
    assert by_scan[19].snapshot.jumps == 2


@pytest.mark.parametrize("map_id", [0x77, 2**32 - 1])
def test_a_reset_after_going_back_to_a_map_is_a_third_one(map_id: int) -> None:
    """Else it would be saved over the stored map that the first reset had begun; and no identity is 0, "none yet"."""

    async def order(bench: Bench) -> None:
        for begin in (0, 10):
            bench.cycle.map_id = map_id
            await bench.drive(begin, 5)
            bench.cycle.inbox.put_command(Command(0.1 * begin + 0.5, Order.RESET))
            await bench.drive(begin + 5, 5)

    ids = [snapshot.map_id for snapshot in on_bench(order).snapshots]
    assert len(set(ids)) == 3
    assert 0 not in ids


def test_a_sink_that_fails_is_said_once_and_harms_nobody(caplog: pytest.LogCaptureFixture) -> None:
    async def broken(bench: Bench) -> None:
        def fail(snapshot: Snapshot) -> None:
            raise OSError("no route")

        bench.cycle.parts.sinks.insert(0, fail)
        await bench.drive(0, 10)
        assert bench.cycle.failing == {0}
        bench.cycle.parts.sinks[0] = lambda snapshot: None
        await bench.drive(10, 1)

    caplog.set_level(logging.ERROR)
    bench = on_bench(broken)
    assert len([r for r in caplog.records if "publisher" in r.message]) == 1
    assert bench.snapshots[-1].pose is not None
    assert bench.cycle.failing == set()


class Ticks:
    """A stopwatch on which every look costs a fixed time."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.now = 0.0

    def __call__(self) -> float:
        self.now += self.seconds
        return self.now


def test_stages_and_overruns_are_accounted_for() -> None:
    bench = on_bench(lambda b: b.drive(0, 20), stopwatch=Ticks(0.002), budget_us=7000.0)
    assert bench.records[5].stage_us == {"bridge": 2000, "step": 2000, "judge": 2000, "publish": 2000}
    assert bench.snapshots[-1].cycle_us == 8000
    assert bench.cycle.overruns == len(bench.records)
    roomy = on_bench(lambda b: b.drive(0, 20), stopwatch=Ticks(0.002), budget_us=9000.0)
    assert roomy.cycle.overruns == 0


def test_the_default_budget_is_half_of_the_learned_period() -> None:
    assert on_bench(lambda b: b.drive(0, 20)).cycle.budget_us == pytest.approx(50_000)


def test_without_a_stopwatch_nothing_measured_is_published() -> None:
    bench = on_bench(lambda b: b.drive(0, 5))
    assert bench.snapshots[-1].cycle_us is None
    assert bench.records[-1].stage_us == {}


def test_the_cap_follows_the_measured_cost() -> None:
    bench = on_bench(lambda b: b.drive(0, 40), stopwatch=Ticks(0.05), budget=MeasuredBudget())
    limits = [record.limits for record in bench.records if record.limits is not None]
    assert limits[0].points > 10_000
    assert limits[-1].points < 681
    assert bench.snapshots[-1].pose is not None


def test_answers_come_back_as_records_of_a_later_cycle() -> None:
    bench = on_bench(lambda b: b.drive(0, 60))
    asked = {record.result.keyframe: record.cycle for record in bench.records if record.result and record.scan == 0}
    applied = [(record.cycle, record.answers) for record in bench.records if record.answers]
    assert applied[0][1] == (1,)
    assert applied[0][0] == asked[1] + 4


def replayed(original: Bench, scans: dict[int, RawScan], odometry: list) -> list[Snapshot]:
    """Drive a second cycle by nothing but the raw streams and the cycle records of a first one."""

    async def go() -> list[Snapshot]:
        loop = asyncio.get_running_loop()
        records = original.records
        schedule = {record.cycle: record.answers for record in records if record.answers}
        bench = Bench(
            budget=RecordedBudget(record.limits for record in records if record.limits is not None),
            worker=ScheduledWorker(schedule),
            odometry=original.odometry,
        )
        fed = 0
        for record in records:
            await asyncio.sleep(max(0.0, record.t_mono - loop.time()))
            for reading in odometry[fed : record.odometry]:
                bench.cycle.inbox.put_odometry(reading)
            fed = record.odometry
            for seq in (*record.dropped, *(() if record.scan is None else (record.scan,))):
                bench.cycle.inbox.put_scan(scans[seq])
            bench.cycle.run()
        return bench.snapshots

    return run_virtual(go())


def test_a_run_repeats_exactly_from_its_raw_streams_and_cycle_records() -> None:
    odometry = [raw_odometry((seq + half) * PERIOD) for seq in range(60) for half in (0.0, 0.5)]

    async def uneven(bench: Bench) -> None:
        await bench.drive(0, 30, odometry=True)
        for seq in (30, 31):
            bench.pacemaker.on_scan(raw_scan(seq, seq * PERIOD))
        for reading in odometry[60:64]:
            bench.cycle.inbox.put_odometry(reading)
        await bench.drive(32, 28, odometry=True)

    first = on_bench(uneven, odometry=True, stopwatch=Ticks(0.04), budget=MeasuredBudget())
    assert len({record.limits for record in first.records}) > 3, "caps that really bind"
    scans = {seq: raw_scan(seq, seq * PERIOD) for seq in range(60)}
    second = replayed(first, scans, odometry)
    assert [(s.pose, s.odom, s.covariance, s.velocity, s.state) for s in second] == [
        (s.pose, s.odom, s.covariance, s.velocity, s.state) for s in first.snapshots
    ]
