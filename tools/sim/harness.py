"""A whole daemon and a whole simulated world in one process and in virtual time, as fast as the machine can.

The lidar is a fake HOKUYO on a memory port that carries the very bytes a tty carries; odometry arrives as the very
datagrams a socket carries; light as words of a fake converter on a memory bus, or at link level as decoded epochs.
Nothing reads a real clock, so one seed gives one result. For tests and experiments.
"""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.app import Daemon, Environment
from daemon.config.endpoints import NO_DEVICE
from daemon.config.schema import Config, LidarConfig, ModbusConfig, Mount, OdometryConfig, PhotodiodeConfig
from daemon.recording.recorder import Recorder
from daemon.runtime.budget import FixedBudget
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import Sink
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from hal.clock import LoopClock, run_virtual
from hal.fake.faults.schedule import FaultSchedule, Target
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import Unit
from hal.fake.transport.memory_host import FakeOpener
from hal.net.inputs import InputPort
from tools.sim.building.world import Array
from tools.sim.feed import feed_odometry
from tools.sim.light.scene import LINK
from tools.sim.light_harness import BUS, LEVEL, LinkBridge, light_up, lights_of
from tools.sim.robot.hands import Hands
from tools.sim.robot.truth import in_map
from tools.sim.scene import Scenario, Scene, SimulatedScene

DEVICE: Final = "/dev/simulated"
_ANY_PORT: Final = 1  # says that odometry is configured; the harness delivers the datagrams itself


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What came out. All arrays have one row per published snapshot; angles in rad, NaN where nothing was known.

    Attributes:
        t_mono: instant each pose is true for. pose: T_map_base (n, 3). odom: T_odom_base (n, 3).
        truth: true poses in the map frame: where the robot stood at the first pose, until light has told where the map
            lies; then the building's own.
        site: true poses in the building's own frame, which is the lights survey's. placed: light has told.
        sigma: (n, 3) one-sigma of x, y, yaw. known: (n, 3) axes said to be observed. state, reason: as published.
        snapshots: all of them, as published. scans_sent: by the fake sensor.
    """

    t_mono: Array
    pose: Array
    odom: Array
    truth: Array
    site: Array
    placed: npt.NDArray[np.bool_]
    sigma: Array
    known: npt.NDArray[np.bool_]
    state: npt.NDArray[np.int64]
    reason: npt.NDArray[np.int64]
    snapshots: tuple[Snapshot, ...] = field(repr=False)
    scans_sent: int

    @property
    def error_m(self) -> Array:
        """Distance between published and true position, (n,)."""
        return np.asarray(np.hypot(*(self.pose[:, :2] - self.truth[:, :2]).T))

    @property
    def error_rad(self) -> Array:
        """Published minus true heading, (n,), wrapped."""
        return np.asarray(np.angle(np.exp(1j * (self.pose[:, 2] - self.truth[:, 2]))))

    def share(self, *states: State) -> float:
        """Share of the snapshots that were in one of the states."""
        return float(np.mean(np.isin(self.state, [int(state) for state in states])))


def run(
    seconds: float,
    scenario: Scenario | None = None,
    scene: Scene | None = None,
    faults: str = "",
    odometry: bool = True,
    lidar: bool = True,
    record: Path | None = None,
) -> Run:
    """Run daemon and world together for some virtual seconds.

    Args:
        seconds: from the first scan asked for.
        scenario: the simulated scene; default the paper's robot in the paper's room.
        scene: another scene, instead of a scenario.
        faults: TOML schedule of faults of the lidar and, with lights, of the converter (``adc``), and of being carried
            (``robot``, see tools/sim/robot/hands.py).
        odometry: whether wheel odometry is fed.
        lidar: whether there is a lidar; without one, lights must be in the scenario.
        record: folder for a recording of the run; light has to come as words of the converter.

    Raises:
        RuntimeError: the daemon ended by itself, or never published a pose.
    """
    if scene is None:
        scene = SimulatedScene(scenario or Scenario())
    x, y, yaw = scene.mount
    seed = scene.scenario.seed if isinstance(scene, SimulatedScene) else 0
    light = lights_of(scene)
    if light is None and not lidar:
        raise ValueError("without a lidar, lights must be in the scenario: Scenario(lights=Lights())")
    settings = Config(
        lidar=LidarConfig(device=DEVICE if lidar else NO_DEVICE, mount=Mount(x, y, math.degrees(yaw))),
        odometry=OdometryConfig(port=_ANY_PORT if odometry else 0),
        modbus=ModbusConfig(port=0),
        photodiode=PhotodiodeConfig(
            bus="" if light is None else BUS, level=LEVEL if light and light.lights.level else ""
        ),
    )
    log = _Log()
    sent = run_virtual(_main(settings, scene, log, _Order(seconds, faults, seed, record)))
    return _collect(log, scene, sent)


@dataclass(frozen=True, slots=True)
class _Order:
    seconds: float
    faults: str
    seed: int
    record: Path | None


class _Log:
    """A sink of the daemon's that keeps every snapshot, and whether light had told by then where the map lies."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self.placed: list[bool] = []
        self.cycle: Cycle | None = None

    def __call__(self, snapshot: Snapshot) -> None:
        result = None if self.cycle is None else self.cycle.result
        self.snapshots.append(snapshot)
        self.placed.append(result is not None and result.placed)


async def _main(settings: Config, scene: Scene, log: _Log, order: _Order) -> int:
    loop = asyncio.get_running_loop()
    clock = LoopClock(loop)
    device = FakeHokuyo(scene.model, scene.scan, unit=Unit(seed=order.seed), rotor=scene.rotor())
    opener = FakeOpener(clock)
    opener.plug(DEVICE, device)
    targets: dict[str, Target] = {"lidar": device}
    around = world(clock, opener, log)
    light = lights_of(scene)
    if light is not None:
        targets |= light_up(around, light, clock)
    if isinstance(scene, SimulatedScene):
        targets["robot"] = Hands(scene, clock.now)
    schedule = FaultSchedule(targets)
    if order.faults:
        schedule.load(order.faults)
    recorder = None if order.record is None else Recorder(order.record, settings, clock, around.lights)
    daemon = Daemon(settings, around, recorder)
    log.cycle = daemon.cycle
    if light is not None and light.lights.fidelity == LINK:
        daemon.cycle.parts.samples = LinkBridge(light)
    stop = asyncio.Event()
    loop.call_later(order.seconds, stop.set)
    wheels = _connect_wheels(daemon, scene, clock, recorder) if settings.odometry.port else None
    try:
        await daemon.run(stop)
    finally:
        if wheels is not None:
            wheels.cancel()
        schedule.close()
        device.close()
    return device.scans_sent


def world(clock: LoopClock, opener: FakeOpener, sink: Sink) -> Environment:
    """What the daemon meets in virtual time: no thread, no stopwatch, no chance."""

    async def warm() -> None:
        from daemon.runtime.warmup import load

        load()

    return Environment(
        clock=clock,
        opener=opener,
        make_worker=CycleWorker,
        make_budget=FixedBudget,
        stopwatch=None,
        warm_up=warm,
        sinks=(sink,),
        draw_map_id=lambda: 1,
    )


def _connect_wheels(daemon: Daemon, scene: Scene, clock: LoopClock, recorder: Recorder | None) -> asyncio.Task[None]:
    """Feed odometry datagrams past the socket, which would wait in real time."""
    for part in ("odometry", "imu"):
        daemon.network.parts.pop(part)
    port = InputPort(clock, "", _ANY_PORT)
    put = daemon.cycle.inbox.put_odometry
    port.send_odometry_to(put if recorder is None else recorder.on_odometry(put))
    return asyncio.create_task(feed_odometry(scene, lambda data: port.receive(data, clock.now())))


def _collect(log: _Log, scene: Scene, scans_sent: int) -> Run:
    snapshots = log.snapshots
    posed = [snapshot for snapshot in snapshots if snapshot.pose is not None]
    if not posed:
        last = snapshots[-1].state.name if snapshots else "no snapshot at all"
        raise RuntimeError(f"the daemon never published a pose; its last state was {last}")
    t = np.array([snapshot.t_mono for snapshot in snapshots])
    covariance = np.array([snapshot.covariance or [np.nan] * 6 for snapshot in snapshots])
    pose = _poses(snapshots, "pose")
    first = snapshots.index(posed[0])
    placed, site = np.array(log.placed), scene.truth(t)
    truth = np.where(placed[:, None], site, in_map(site, site[first], pose[first]))
    return Run(
        t_mono=t,
        pose=pose,
        odom=_poses(snapshots, "odom"),
        truth=truth,
        site=site,
        placed=placed,
        sigma=np.sqrt(covariance[:, [0, 2, 5]]),
        known=np.array([snapshot.known for snapshot in snapshots]),
        state=np.array([int(snapshot.state) for snapshot in snapshots]),
        reason=np.array([snapshot.reason for snapshot in snapshots]),
        snapshots=tuple(snapshots),
        scans_sent=scans_sent,
    )


def _poses(snapshots: list[Snapshot], name: str) -> Array:
    return np.array([getattr(snapshot, name) or [np.nan] * 3 for snapshot in snapshots])
