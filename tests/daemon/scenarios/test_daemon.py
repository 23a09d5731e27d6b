"""The whole daemon in virtual time: real driver and estimator, the fake HOKUYO on a memory port, every byte carried."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import pytest

from daemon.app import Daemon, Environment
from daemon.config.schema import Config, LidarConfig, MapConfig, ModbusConfig, Mount
from daemon.health.faults import Fault
from daemon.health.reasons import Reason
from daemon.maps.initial_state import started
from daemon.runtime.budget import FixedBudget
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from estimator.numerics import se2
from hal.clock import LoopClock, run_virtual
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.dialect_grid import State as Sensor
from hal.fake.lidar.models import URG_04LX_UG01, LidarModel, Unit
from hal.fake.lidar.scan_world import Room
from hal.fake.transport.memory_host import FakeOpener
from hal.imu import RawImu
from hal.odometry import RawOdometry
from tests.daemon.support.whole_daemon import during

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
        assert bench.last.fault == Fault.COMPUTER_SLOW
        assert bench.daemon.heartbeat.faults[:2] == (Fault.COMPUTER_SLOW, Fault.OVERRUNS)

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
