"""The whole daemon in virtual time: real driver and estimator, the fake HOKUYO on a memory port, every byte carried."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest

from daemon.app import Daemon, Environment
from daemon.config.schema import Config, LidarConfig, MapConfig, ModbusConfig, Mount
from daemon.health.faults import Fault
from daemon.health.reasons import Reason
from daemon.integrity.evidence import SILENT_PERIODS
from daemon.maps.initial_state import started
from daemon.runtime.budget import FixedBudget
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from estimator.numerics import se2
from hal.clock import LoopClock, run_virtual
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State as Sensor
from hal.fake.lidar.models import URG_04LX_UG01, LidarModel, Unit
from hal.fake.lidar.scan_world import Room
from hal.fake.schedule import FaultSchedule
from hal.fake.transport import FakeOpener
from hal.imu import RawImu
from hal.odometry import RawOdometry
from tests.daemon.driven import during

DEVICE = "/dev/ttyACM0"
PERIOD = URG_04LX_UG01.true_period_s
UNKEPT = MapConfig(folder="none")
SETTINGS = Config(lidar=LidarConfig(device=DEVICE), modbus=ModbusConfig(port=0), map=UNKEPT)


async def warm() -> None:
    """Nothing to load: the estimator compiles on first use in this process."""


class Parked(Room):
    """The same room, the robot at rest."""

    def pose(self, t_mono: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return super().pose(np.zeros_like(t_mono))


@dataclass
class Bench:
    """A daemon and its lidar. `order` takes fault orders as TOML, `snapshots` holds everything published."""

    settings: Config = SETTINGS
    model: LidarModel = URG_04LX_UG01
    unit: Unit = field(default_factory=Unit)
    plugged: bool = True
    world: Callable[[LidarModel], Room] = Room
    stopwatch: Callable[[], float] | None = None
    snapshots: list[Snapshot] = field(default_factory=list)
    left: Sensor | None = None

    def __post_init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        clock = LoopClock(self.loop, utc_at_zero=1.7e9)
        self.room = self.world(self.model)
        self.device = FakeHokuyo(self.model, self.room, unit=self.unit)
        self.opener = FakeOpener(clock)
        if self.plugged:
            self.opener.plug(DEVICE, self.device)
        self.faults = FaultSchedule({"lidar": self.device})
        store, start = started(self.settings.map, None)
        world = Environment(
            clock,
            opener=self.opener,
            make_worker=CycleWorker,
            make_budget=FixedBudget,
            stopwatch=self.stopwatch,
            warm_up=warm,
            sinks=(self.snapshots.append,),
            draw_map_id=lambda: 4711,
            store=store,
            start=start,
        )
        self.daemon = Daemon(self.settings, world)

    @property
    def last(self) -> Snapshot:
        return self.snapshots[-1]

    async def until(self, state: State, seconds: float) -> Snapshot:
        """The first snapshot with a state, at most ``seconds`` from now."""
        end = self.loop.time() + seconds
        seen = len(self.snapshots)
        while self.loop.time() < end:
            for snapshot in self.snapshots[seen:]:
                if snapshot.state is state:
                    return snapshot
            seen = len(self.snapshots)
            await asyncio.sleep(0.01)
        raise AssertionError(f"no {state.name} within {seconds} s; {self.last}")

    def off(self, snapshot: Snapshot, first: Snapshot) -> tuple[float, float]:
        """Error of the motion from one snapshot to another, in m and rad."""
        truth = self.room.pose(np.array([first.t_mono, snapshot.t_mono]))
        true = se2.between(truth[0], truth[1])
        told = se2.between(np.array(first.pose), np.array(snapshot.pose))
        dx, dy, dyaw = se2.between(true, told).tolist()
        return math.hypot(dx, dy), abs(dyaw)

    async def send_odometry(self, seconds: float, scale: float = 1.0) -> None:
        """True odometry at 20 Hz, or with a wrong scale."""
        start = self.room.pose(np.array([self.loop.time()]))[0]
        for _ in range(round(seconds * 20)):
            await asyncio.sleep(0.05)
            t = self.loop.time()
            x, y, yaw = se2.between(start, self.room.pose(np.array([t]))[0]).tolist()
            self.daemon.cycle.inbox.put_odometry(RawOdometry(t, t, scale * x, scale * y, yaw))


def run_daemon(
    scenario: Callable[[Bench], Awaitable[None]], bench: type[Bench] | None = None, **options: object
) -> Bench:
    """Run the daemon around a scenario, stop it as a signal would, and hand back what is left."""

    kind = bench or Bench

    async def go() -> Bench:
        bench = kind(**options)  # type: ignore[arg-type]  # test shorthand
        try:
            await during(bench.daemon, scenario(bench))
        finally:
            bench.left = bench.device.state
        return bench

    return run_virtual(go())


def test_a_lidar_in_a_pose_out() -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 4.0)
        await asyncio.sleep(20.0)
        poses = [s for s in bench.snapshots if s.pose is not None and s.seq > first.seq]
        worst_m = max(bench.off(s, first)[0] for s in poses)
        worst_rad = max(bench.off(s, first)[1] for s in poses)
        assert worst_m < 0.05
        assert worst_rad < 0.02
        last = bench.last
        assert (last.state, last.fault, last.missed, last.map_id) == (State.TRACKING, 0, 0, 4711)
        assert last.lidar_ok is True
        assert last.odometry_ok is None
        assert last.scan_rate == pytest.approx(1 / PERIOD, rel=1e-3)
        assert last.t_sent - last.t_mono < PERIOD

    run_daemon(scenario)


def test_the_laser_is_switched_off_on_the_way_out() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.MAPPING, 3.0)
        assert bench.device.state is Sensor.MULTI

    assert run_daemon(scenario).left is Sensor.IDLE, "before the daemon says that it has ended"


def test_with_odometry_two_witnesses_agree() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.MAPPING, 3.0)
        await bench.send_odometry(8.0)
        assert bench.daemon.cycle.observer.motion_consistency.agree() is True
        assert (bench.last.state, bench.last.odometry_ok) == (State.TRACKING, True)

    run_daemon(scenario)


def test_a_slow_lidar_that_loses_a_scan_does_not_make_odometry_silent(caplog: pytest.LogCaptureFixture) -> None:
    """Once a second: readings wait for over a second for a cycle that takes them, and have arrived all the same."""

    async def scenario(bench: Bench) -> None:
        sender = asyncio.create_task(bench.send_odometry(60.0))
        await bench.until(State.TRACKING, 30.0)
        bench.faults.load('[[fault]]\nwhat = "intermittent"\nshare = 0.4')
        await asyncio.sleep(20.0)
        sender.cancel()
        assert bench.daemon.cycle.parts.status.missed > 0
        assert "fault 201" not in caplog.text
        await asyncio.sleep(2.5)
        assert "fault 201" in caplog.text

    run_daemon(scenario, model=replace(URG_04LX_UG01, rpm=60, true_period_s=1.0), world=Parked)


def test_odometry_with_a_wrong_scale_is_not_called_tracking() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.TRACKING, 6.0)
        await bench.send_odometry(12.0, scale=2.5)
        assert (bench.last.state, bench.last.reason) == (State.DEGRADED, Reason.WITNESSES_DISAGREE)
        assert bench.last.fault == Fault.ODOMETRY_DISAGREES

    run_daemon(scenario)


def test_a_lidar_that_vanishes_and_returns(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    async def scenario(bench: Bench) -> None:
        sender = asyncio.create_task(bench.send_odometry(60.0))
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        last_scan = bench.daemon.cycle.observer._t_scan
        bench.opener.unplug(DEVICE)
        gone = await bench.until(State.NO_LIDAR, 2.0)
        assert last_scan is not None
        assert gone.t_sent - last_scan <= (SILENT_PERIODS + 1.1) * PERIOD
        await asyncio.sleep(3.0)
        assert bench.last.fault == Fault.LIDAR_MISSING
        assert bench.last.reason == Reason.LIDAR_UNREACHABLE
        bench.opener.plug(DEVICE, bench.device)
        await bench.until(State.TRACKING, 20.0)
        off_m, off_rad = bench.off(bench.last, first)
        assert off_m < 0.1
        assert off_rad < 0.03
        await asyncio.sleep(12.0)
        assert bench.last.fault == 0
        sender.cancel()

    run_daemon(scenario)
    lost = [r.message for r in caplog.records if "lidar lost" in r.message]
    assert len(lost) == 2, "unplugged; no such device: once each"
    assert all(DEVICE in line for line in lost)
    assert sum("delivers again" in r.message for r in caplog.records) == 1


@pytest.mark.parametrize("odometry", [False, True])
def test_a_gyro_in_degrees_does_not_mislead(odometry: bool) -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        wheels = asyncio.create_task(bench.send_odometry(60.0)) if odometry else None
        since = len(bench.snapshots)
        for _ in range(2000):
            t = bench.loop.time()
            before, now = bench.room.pose(np.array([t - 1e-3, t]))
            rate = math.degrees(se2.between(before, now)[2]) / 1e-3
            bench.daemon.cycle.inbox.put_imu(RawImu(t, t, rate))
            await asyncio.sleep(0.01)
        if wheels is not None:
            wheels.cancel()
        tracked = [snapshot for snapshot in bench.snapshots[since:] if snapshot.state is State.TRACKING]
        assert len(tracked) > 100
        assert max(bench.off(snapshot, first)[0] for snapshot in tracked) < 0.1

    run_daemon(scenario)


@pytest.mark.parametrize("after_s", [0.0, 6.0])
def test_a_lidar_that_never_answers_does_not_make_the_state_flicker(
    after_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)

    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(after_s)
        bench.faults.load('[[fault]]\nwhat = "silence"\nwhen = 0.0\nfor = 125.0\n')
        since = len(bench.snapshots)
        await asyncio.sleep(120.0)
        said = [(snapshot.state, snapshot.reason) for snapshot in bench.snapshots[since:]]
        news = [after for before, after in pairwise(said) if before != after]
        assert len(news) <= 3
        assert said[-1] == (State.NO_LIDAR, Reason.LIDAR_UNREACHABLE)
        await asyncio.sleep(20.0)
        assert bench.last.lidar_ok, "and it has not given up"

    run_daemon(scenario)
    assert sum("NO_LIDAR" in record.message for record in caplog.records) <= 2


def test_a_gap_that_nothing_bridged_is_not_called_tracking_unless_it_is_right() -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        bench.opener.unplug(DEVICE)
        await asyncio.sleep(5.0)
        bench.opener.plug(DEVICE, bench.device)
        since = len(bench.snapshots)
        await asyncio.sleep(30.0)
        assert bench.last.lidar_ok
        assert bench.last.state is not State.NO_LIDAR
        _never_wrong(bench, first)
        assert all(s.pose is not None for s in bench.snapshots[since:])

    run_daemon(scenario)


def test_a_robot_that_stood_still_through_a_gap_is_tracking_again() -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        bench.opener.unplug(DEVICE)
        await asyncio.sleep(20.0)
        bench.opener.plug(DEVICE, bench.device)
        await bench.until(State.TRACKING, 15.0)
        _never_wrong(bench, first)

    run_daemon(scenario, world=Parked)


def _never_wrong(bench: Bench, first: Snapshot) -> None:
    for snapshot in bench.snapshots:
        if snapshot.pose is not None and snapshot.state is State.TRACKING:
            off_m, off_rad = bench.off(snapshot, first)
            assert off_m < 0.1
            assert off_rad < 0.03


def test_no_lidar_from_the_start_is_said_and_mended_by_plugging_it_in() -> None:
    async def scenario(bench: Bench) -> None:
        missing = await bench.until(State.NO_LIDAR, 1.0)
        assert missing.reason == Reason.LIDAR_UNREACHABLE
        await asyncio.sleep(30.0)
        assert bench.last.state is State.NO_LIDAR
        bench.opener.plug(DEVICE, bench.device)
        await bench.until(State.TRACKING, 12.0)

    run_daemon(scenario, plugged=False)


@pytest.mark.parametrize(
    "order",
    [
        'what = "garbage"\nfor = 4.0\nshare = 0.3\non = "scans"',
        'what = "bit_flip"\nfor = 4.0\nshare = 0.5',
        'what = "cut_frame"\nfor = 4.0\nshare = 0.3',
        'what = "chunks"\nfor = 4.0\npiece = 7\nsplit_end = true',
        'what = "stall"\nfor = 2.0',
        'what = "reset"',
    ],
)
def test_trouble_on_the_line_never_makes_a_wrong_pose(order: str) -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        bench.faults.load(f"[[fault]]\n{order}")
        await asyncio.sleep(25.0)
        assert bench.last.lidar_ok
        _never_wrong(bench, first)

    run_daemon(scenario)


def test_damaged_frames_are_counted_and_named() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.TRACKING, 6.0)
        bench.faults.load('[[fault]]\nwhat = "bit_flip"\nfor = 10.0\nevery = 4')
        await asyncio.sleep(8.0)
        assert bench.daemon.heartbeat.faults[0] is Fault.LIDAR_GARBLED
        assert bench.last.missed >= 15
        await asyncio.sleep(20.0)
        assert bench.daemon.heartbeat.faults == ()

    run_daemon(scenario)


def test_a_sensor_that_falls_silent_without_a_word() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.TRACKING, 6.0)
        bench.faults.load('[[fault]]\nwhat = "silence"\nfor = 8.0')
        silent = await bench.until(State.NO_LIDAR, 1.0)
        assert silent.reason == Reason.LIDAR_SILENT
        await asyncio.sleep(2.0)
        assert bench.last.fault in (Fault.LIDAR_SILENT, Fault.LIDAR_BROKEN)
        await bench.until(State.TRACKING, 40.0)

    run_daemon(scenario, world=Parked)


def test_mount_and_inversion_reach_the_pose() -> None:
    """A lidar hung upside down half a metre ahead, described as such, yields the robot's own motion."""

    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await asyncio.sleep(10.0)
        truth = bench.room.pose(np.array([first.t_mono, bench.last.t_mono]))
        mount = np.array((0.5, 0.1, math.radians(30.0)))
        flipped = [np.array((x, -y, -yaw)) for x, y, yaw in truth.tolist()]  # seen from below
        base = [se2.compose(pose, se2.inverse(mount)) for pose in flipped]
        expected = se2.between(base[0], base[1])
        told = se2.between(np.array(first.pose), np.array(bench.last.pose))
        np.testing.assert_allclose(told, expected, atol=0.04)

    mount = Mount(x=0.5, y=0.1, yaw=30.0, inverted=True)
    run_daemon(scenario, settings=replace_lidar(mount=mount))


def replace_lidar(**changes: object) -> Config:
    lidar = LidarConfig(**{"device": DEVICE, **changes})  # type: ignore[arg-type]  # test shorthand
    return Config(lidar=lidar, modbus=ModbusConfig(port=0), map=UNKEPT)


def test_overruns_are_counted_published_and_named() -> None:
    class Slow:
        """Every look at the stopwatch costs 20 ms."""

        now = 0.0

        def __call__(self) -> float:
            self.now += 0.02
            return self.now

    async def scenario(bench: Bench) -> None:
        await bench.until(State.MAPPING, 3.0)
        await asyncio.sleep(3.0)
        assert bench.last.cycle_us in (140_000, 160_000), "20 ms a stage, with or without map work"
        assert bench.last.overruns > 20
        assert bench.last.fault == Fault.OVERRUNS

    run_daemon(scenario, stopwatch=Slow())


def test_two_runs_publish_the_same() -> None:
    async def scenario(bench: Bench) -> None:
        bench.faults.load('[[fault]]\nwhat = "bit_flip"\nshare = 0.1\nwhen = 2.0\nfor = 2.0')
        await asyncio.sleep(6.0)

    first, second = run_daemon(scenario), run_daemon(scenario)
    assert len(first.snapshots) > 50
    assert first.snapshots == second.snapshots


def test_a_defect_in_the_cycle_ends_the_daemon_and_still_switches_the_laser_off() -> None:
    def broken(snapshot: Snapshot) -> None:
        raise RuntimeError("never seen: sinks are guarded")

    async def go() -> FakeHokuyo:
        bench = Bench()

        def fail(records: object, limits: object) -> None:
            raise ZeroDivisionError("a defect")

        bench.daemon.cycle.parts.step = fail  # type: ignore[assignment]  # the defect under test
        bench.daemon.cycle.parts.sinks.insert(0, broken)
        with pytest.raises(ZeroDivisionError, match="a defect"):
            await bench.daemon.run(asyncio.Event())
        return bench.device

    assert run_virtual(go()).state is Sensor.IDLE
