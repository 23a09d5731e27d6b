"""The whole daemon in a whole simulated house in virtual time, with every device it can lose, and a record of it all.

A robot with a lidar of 10 Hz, wheel odometry and a photodiode drives through the paper's room under coded lamps. The
daemon may be stopped and started again while world and devices go on. Nothing reads a real clock or opens a socket.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Final

import numpy as np

from daemon.app import Daemon
from daemon.config.schema import Config, LidarConfig, ModbusConfig, Mount, OdometryConfig, PhotodiodeConfig
from daemon.health.faults import Fault
from daemon.maps.image import meta_of, packed
from daemon.maps.schema import digest_of, read
from daemon.maps.store import Start
from daemon.snapshot import Snapshot, State
from estimator.mapping.map_snapshot import Identity
from estimator.stored_map import image_of
from hal.clock import LoopClock, run_virtual
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import UTM_30LX, LidarModel, Unit
from hal.fake.odometry import FakeOdometry
from hal.fake.transport.memory_host import FakeOpener
from hal.net.inputs import InputPort
from tools.sim.ceiling.ceiling import Effects
from tools.sim.ceiling.effects import IDEAL
from tools.sim.harness import DEVICE, world
from tools.sim.light.scene import Lights
from tools.sim.light_harness import BUS, light_up, lights_of
from tools.sim.robot.drive import Body
from tools.sim.robot.odometry import Wheels
from tools.sim.robot.truth import in_map
from tools.sim.scene import Scenario, SimulatedScene

LIDAR: Final[LidarModel] = replace(UTM_30LX, ares=480, amin=0, amax=360, afrt=180, rpm=600, true_period_s=0.1002)
"""A UTM-30LX that turns at 10 Hz and measures 361 beams: all of its dialect at an eighth of the work."""
PERIOD_S: Final = LIDAR.true_period_s
ROBOT: Final = Scenario(
    lidar=LIDAR, seed=1, dwell_s=0.5, body=Body(speed=0.5),
    lights=Lights(effects=Effects(gain_spread=0.0, receiver_gain=0.0, warm_up=0.0)),
)  # fmt: skip
"""Half a metre a second under lamps whose brightness has been calibrated; everything else as rough as ever."""
SURVEYOR: Final = replace(
    ROBOT, people=False, lights=Lights(effects=IDEAL), wheels=Wheels(scale=0.0, base_scale=0.0, slips_per_m=0.0)
)
"""Whoever made the map that the robot has: nobody about, lamps as planned, good wheels."""
SURVEY_S: Final = 100.0
_PORT: Final = 1


@dataclass(frozen=True, slots=True)
class Sight:
    """One published snapshot and what there was to compare it with.

    Attributes:
        truth: (x, y, yaw) in the map frame. faults: all that were present.
    """

    snapshot: Snapshot
    truth: tuple[float, float, float]
    faults: tuple[Fault, ...]

    @property
    def t(self) -> float:
        """When it was published."""
        return self.snapshot.t_sent

    @property
    def error_m(self) -> float | None:
        """Distance from the truth; None without a pose."""
        pose = self.snapshot.pose
        return None if pose is None else math.hypot(pose[0] - self.truth[0], pose[1] - self.truth[1])

    @property
    def sigmas(self) -> float | None:
        """Largest error of x and y in their one-sigma; None without a covariance."""
        pose, P = self.snapshot.pose, self.snapshot.covariance
        if pose is None or P is None:
            return None
        return max(abs(pose[0] - self.truth[0]) / math.sqrt(P[0]), abs(pose[1] - self.truth[1]) / math.sqrt(P[2]))


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the log."""

    t: float
    level: int
    name: str
    text: str


class _Ear(logging.Handler):
    """Keeps the log with the loop's time."""

    def __init__(self, now: Callable[[], float]) -> None:
        super().__init__()
        self._now = now
        self.lines: list[Line] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(Line(self._now(), record.levelno, record.name, record.getMessage()))


@dataclass
class House:
    """World, devices and one daemon after the other.

    Attributes:
        map: that the robot has, as a file; None: none.
        sights: everything published. faults: orders of ``lidar``, ``adc`` and ``odometry``.
        lines: the log. daemon: the present one.
    """

    scenario: Scenario = ROBOT
    map: bytes | None = None
    sights: list[Sight] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.clock = LoopClock(self.loop, utc_at_zero=1.7e9)
        self.scene = SimulatedScene(self.scenario)
        self.lidar = FakeHokuyo(self.scene.model, self.scene.scan, unit=Unit(seed=self.scenario.seed))
        opener = FakeOpener(self.clock)
        opener.plug(DEVICE, self.lidar)
        self.world = world(self.clock, opener, self._keep)
        light = lights_of(self.scene)
        assert light is not None
        adc = light_up(self.world, light, self.clock)["adc"]
        self._port = InputPort(self.clock, "", _PORT)
        self.wheels = FakeOdometry(self._reading, lambda data: self._port.receive(data, self.clock.now()))
        self._rolling = asyncio.create_task(self.wheels.run())
        self.faults = FaultSchedule({"lidar": self.lidar, "adc": adc, "odometry": self.wheels})
        self._ear = _Ear(self.loop.time)
        self.lines = self._ear.lines
        x, y, yaw = self.scene.mount
        self.settings = Config(
            lidar=LidarConfig(device=DEVICE, mount=Mount(x, y, math.degrees(yaw))),
            odometry=OdometryConfig(port=_PORT),
            modbus=ModbusConfig(port=0),
            photodiode=PhotodiodeConfig(bus=BUS),
        )
        self._anchor: tuple[np.ndarray, np.ndarray] | None = None
        self._stop = asyncio.Event()
        self._running: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start a daemon, as a service manager would."""
        self.world.start = None if self.map is None else Start(self.map, read(self.map))
        self.daemon = Daemon(self.settings, self.world)
        for part in ("odometry", "imu"):  # their socket would wait in real time
            self.daemon.network.parts.pop(part)
        self._port = InputPort(self.clock, "", _PORT)  # a new process has heard nothing yet
        self._port.send_odometry_to(self.daemon.cycle.inbox.put_odometry)
        self._stop, self._anchor = asyncio.Event(), None
        self._running = asyncio.create_task(self.daemon.run(self._stop))

    async def stop(self, patience_s: float = 10.0) -> float:
        """Stop it as a signal would; the seconds it took. Raises what it raised, and TimeoutError."""
        assert self._running is not None
        asked = self.loop.time()
        self._stop.set()
        await asyncio.wait_for(asyncio.shield(self._running), patience_s)
        self._running = None
        self._port.send_odometry_to(None)
        return self.loop.time() - asked

    @property
    def ended(self) -> str:
        """Why the daemon has ended by itself; empty while it runs."""
        if self._running is None or not self._running.done():
            return ""
        error = self._running.exception()
        return "it ended by itself" if error is None else f"it ended with {error!r}"

    def drawn(self) -> bytes:
        """The map as it is now, as a file."""
        state, lights = self.daemon.autosaver._state(), self.world.lights
        assert state is not None
        assert lights is not None
        who = Identity(map_id=1, name="", surveyed=True, survey=digest_of(lights.survey), session=1)
        image = image_of(state, who)
        return packed(image, meta_of(image, 1.7e9, "robot", "0"))

    def order(self, toml: str) -> None:
        """Take orders for the devices: TOML with `; ` for a new line and ` + ` between orders."""
        for text in filter(None, toml.split(" + ")):
            self.faults.load("[[fault]]\n" + text.replace("; ", "\n"))

    async def until(self, so: Callable[[], bool], seconds: float) -> bool:
        """Wait for something to become true; whether it has within ``seconds``."""
        end = self.loop.time() + seconds
        while self.loop.time() < end and not self.ended:
            if so():
                return True
            await asyncio.sleep(0.02)
        return so()

    async def close(self) -> None:
        """End everything that still runs."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.wait([self._running])
        self._rolling.cancel()
        self.faults.close()
        self.lidar.close()

    def listen(self) -> _Ear:
        """The handler that keeps the log."""
        return self._ear

    def _reading(self, t_mono: float) -> tuple[float, tuple[float, float, float]] | None:
        reading = self.scene.odometry_after(t_mono)
        assert reading is not None
        x, y, yaw = reading[1].tolist()
        return reading[0], (x, y, yaw)

    def _keep(self, snapshot: Snapshot) -> None:
        site = self.scene.truth(np.array([snapshot.t_mono]))[0]
        result = self.daemon.cycle.result
        placed = result is not None and result.placed
        if snapshot.pose is not None and self._anchor is None:
            self._anchor = site, np.array(snapshot.pose)
        truth = site if placed or self._anchor is None else in_map(site, *self._anchor)
        x, y, yaw = truth.tolist()
        self.sights.append(Sight(snapshot, (x, y, yaw), self.daemon.heartbeat.faults))


@cache
def surveyed() -> bytes:
    """A map of the room, made by driving through it once."""
    drawn: list[bytes] = []

    async def drive(house: House) -> None:
        house.start()
        await asyncio.sleep(SURVEY_S)
        drawn.append(house.drawn())
        await house.stop()

    live(drive, SURVEYOR, None)
    return drawn[0]


def live(story: Callable[[House], Awaitable[None]], scenario: Scenario, drawn: bytes | None) -> House:
    """Let a story happen in a house, with a robot that has a map or none; what it raises is raised."""

    async def go() -> House:
        house = House(scenario, drawn)
        root = logging.getLogger()
        before = root.level
        root.addHandler(house.listen())
        root.setLevel(logging.INFO)
        try:
            await story(house)
        finally:
            root.removeHandler(house.listen())
            root.setLevel(before)
            await house.close()
        return house

    return run_virtual(go(), start=100.0)


def tracking(sight: Sight) -> bool:
    """Whether the pose is said to be confirmed."""
    return sight.snapshot.state is State.TRACKING
