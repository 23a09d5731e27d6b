"""A building, a robot that drives through it, its lidar and its wheels: what the fake devices are fed from.

Two kinds of scene have the same face (:class:`Scene`): the simulated one here, and a recorded log's in
:mod:`tools.sim.hybrid`. A scene knows nothing of SCIP, sockets or the daemon.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from hal.fake.lidar.models import MODELS, LidarModel
from hal.fake.lidar.rotor import Rotor
from hal.fake.lidar.scan import FakeScan
from tools.sim.building import beams
from tools.sim.building.beams import Optics, Posture, Returns, Scanner, Sweep
from tools.sim.building.building import Building
from tools.sim.building.buildings import building
from tools.sim.building.people import Crowd
from tools.sim.building.world import Array
from tools.sim.light.scene import Lights, SceneLight
from tools.sim.robot.drive import Body, Drive, compose
from tools.sim.robot.hands import Way, start_of, then
from tools.sim.robot.odometry import Odometer, Wheels

OPTICS: Final[dict[str, Optics]] = {
    "URG-04LX": beams.URG_04LX, "URG-04LX-UG01": beams.URG_04LX, "UBG-04LX-F01": beams.URG_04LX,
    "UHG-08LX": beams.URG_04LX, "UST-10LX": beams.UST_20LX, "UST-20LX": beams.UST_20LX,
}  # fmt: skip
"""Optics by model name; every other model measures like a UTM-30LX."""


class Scene(Protocol):
    """What drives the fake devices, and the ground truth to judge by. Times are ``t_mono`` of the caller's clock."""

    @property
    def model(self) -> LidarModel:
        """The type of lidar the scans are made for."""
        ...

    @property
    def mount(self) -> tuple[float, float, float]:
        """Where the lidar sits on the robot: (x, y, yaw) in base_link, m and rad."""
        ...

    def rotor(self) -> Rotor | None:
        """When the sensor turns; None: as its motor does by itself."""
        ...

    def scan(self, t_mono: float) -> FakeScan | None:
        """A :data:`hal.fake.lidar.scan.ScanSource`."""
        ...

    def odometry_after(self, t_mono: float) -> tuple[float, Array] | None:
        """The first wheel odometry reading later than ``t_mono``: its time and pose; None: there are no more."""
        ...

    def truth(self, t_mono: Array) -> Array:
        """(n, 3) true poses of base_link in the scene's own frame at (n,) times."""
        ...


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything that makes a simulated run repeatable.

    Attributes:
        building: name, see :data:`tools.sim.building.buildings.BUILDINGS`.
        lidar: name in :data:`hal.fake.lidar.models.MODELS`, or a model of one's own.
        seed: of noise, people and slip. people: False empties the building.
        dwell_s: standing still before each lap. laps: how many.
        optics: None takes the lidar's own. lights: coded lamps overhead; None: there are none.
    """

    building: str = "paper_room"
    lidar: str | LidarModel = "paper"
    seed: int = 0
    people: bool = True
    dwell_s: float = 2.0
    laps: float = np.inf
    body: Body = field(default_factory=Body)
    wheels: Wheels = field(default_factory=Wheels)
    optics: Optics | None = None
    lights: Lights | None = None


PAPER: Final = Scenario(laps=1)
"""The paper's robot: 180 deg, 721 beams, 40 Hz, a 160 m drive that returns to its start."""


class SimulatedScene:
    """A robot on its tour through a building. People start to walk with the first scan, or block of light, asked for.

    So does the robot, unless it is held: then it drives off with the first one after :meth:`release`. Until it does it
    stands at the start, so that a daemon that is slow to start misses nothing.

    Attributes:
        light: the lamps overhead, None if there are none.
    """

    def __init__(self, scenario: Scenario, place: Building | None = None, held: bool = False) -> None:
        self.scenario = scenario
        self.model = lidar_model(scenario.lidar)
        self.building = place or building(scenario.building)
        self.drive = Drive(self.building.route, scenario.body, scenario.dwell_s, scenario.laps)
        self.optics = scenario.optics or OPTICS.get(str(scenario.lidar), beams.UTM_30LX)
        self.held = held
        self.t_go: float | None = None
        self._way = Way(self.drive)
        self._counted = np.zeros(3)
        self._put_down = 0
        self._t_first: float | None = None
        self._crowd = Crowd(self.building.people if scenario.people else ())
        self._scanner = Scanner(self.building.world, sweep_of(self.model), self.optics, scenario.seed)
        self._odometer = Odometer(self.drive, self.building.world, scenario.wheels, scenario.seed)
        self.light: SceneLight | None = None
        if scenario.lights is not None:
            self.light = SceneLight(self, self.building, self._crowd, scenario.lights, scenario.seed)

    @property
    def mount(self) -> tuple[float, float, float]:
        """See :class:`Scene`."""
        return self.scenario.body.lidar

    def rotor(self) -> None:
        """See :class:`Scene`: the model's own motor."""
        return

    def scan(self, t_mono: float) -> FakeScan:
        """See :class:`Scene`."""
        first = self.begin(t_mono)
        t = t_mono - first
        since = first - t_mono if self.t_go is None else first - self.t_go  # <= 0: not driving yet
        pitch, roll = self.drive.tilt(float(self._way.clock(np.array([t + since]))[0]))
        robot = self._way.poses(np.array([t + since]))[0]
        legs = self._crowd.legs(t + self._scanner.sweep.first_s, robot)
        posture = Posture(self.scenario.body.height, pitch, roll)
        seen = self._scanner.measure(t, lambda at: compose(self._way.poses(at + since), self.mount), legs, posture)
        if self._way.in_the_air(t + since):
            seen = Returns(np.zeros_like(seen.range_m), np.zeros_like(seen.intensity))
        return to_device(self.model, seen)

    def begin(self, t_mono: float) -> float:
        """A sensor is read: people walk, and the robot drives off unless it is held. Returns when that first was."""
        if self._t_first is None:
            self._t_first = t_mono
            self._surprise()
        if self.t_go is None and not self.held:
            self.t_go = t_mono
            self._surprise()
        return self._t_first

    def _surprise(self) -> None:
        if self.light is not None:
            self.light.stream.track.forget()

    def release(self) -> None:
        """Let a held robot drive off."""
        self.held = False

    def driven(self, t_mono: Array) -> Array:
        """(n,) s on the drive's clock: since the robot drove off, 0 before; being carried, it stands still."""
        return np.zeros(len(t_mono)) if self.t_go is None else self._way.clock(t_mono - self.t_go)

    def carry(self, t_mono: float, ahead_s: float, takes_s: float) -> None:
        """Lift the robot and put it down further along its tour; one that is held stays."""
        if self.t_go is not None:
            self._way.carry(t_mono - self.t_go, ahead_s, takes_s)
            self._surprise()

    def walked(self, t_mono: Array) -> Array:
        """(n,) s since people began to walk, 0 before."""
        return np.zeros(len(t_mono)) if self._t_first is None else np.maximum(t_mono - self._t_first, 0.0)

    def odometry_after(self, t_mono: float) -> tuple[float, Array] | None:
        """See :class:`Scene`; readings start with the clock, before that the wheels stand still."""
        rate = self.scenario.wheels.rate_hz
        if self.t_go is None:
            return t_mono + 1.0 / rate, np.zeros(3)
        k = max(int(np.floor((t_mono - self.t_go) * rate + 1e-6)) + 1, 0)
        return self.t_go + k / rate, self._rolled(k / rate)

    def _rolled(self, t: float) -> Array:
        """What the wheels have counted at ``t`` since the robot drove off: nothing of being carried."""
        rate, carries = self.scenario.wheels.rate_hz, self._way.carries
        while self._put_down < len(carries) and t >= carries[self._put_down].t_down:
            one = carries[self._put_down]
            before = then(self._counted, self._odometer.reading(round(one.from_s * rate)))
            self._counted = start_of(before, self._odometer.reading(round(one.to_s * rate)))
            self._put_down += 1
        there = float(self._way.clock(np.array([t]))[0])
        return then(self._counted, self._odometer.reading(round(there * rate)))

    def truth(self, t_mono: Array) -> Array:
        """See :class:`Scene`."""
        if self.t_go is None:
            return self.drive.pose(np.zeros(len(t_mono)))
        return self._way.poses(np.asarray(t_mono) - self.t_go)


def lidar_model(name: str | LidarModel) -> LidarModel:
    """The model of that name; raises ValueError that lists the names there are."""
    if isinstance(name, LidarModel):
        return name
    if name not in MODELS:
        raise ValueError(f"no lidar is called {name!r}; there are: {', '.join(MODELS)}")
    return MODELS[name]


def sweep_of(model: LidarModel) -> Sweep:
    """Bearings and times of all steps of a model."""
    steps = np.arange(model.amin, model.amax + 1)
    per_step = model.true_period_s / model.ares
    bearing = np.asarray((steps - model.afrt) * (2 * np.pi / model.ares), dtype=np.float64)
    return Sweep(bearing, model.amin * per_step, (model.amax - model.amin) * per_step)


def no_return(model: LidarModel) -> int:
    """What a model reports for a beam that met nothing: above DMAX (2.2 dialect), or an error code below DMIN."""
    if model.profile == "2.2":
        return max(65533, model.dmax + 1)
    return 1 if model.dmax > 10000 else 0


def to_device(model: LidarModel, seen: Returns) -> FakeScan:
    """Echoes in m as the sensor's own words for steps 0 to AMAX."""
    millimetres = np.where(seen.range_m > 0.0, np.rint(seen.range_m * 1000.0), 0.0).astype(np.int32)
    millimetres[millimetres > model.dmax] = 0
    ranges = np.zeros((model.steps, millimetres.shape[1]), dtype=np.int32)
    intensity = np.zeros_like(ranges)
    ranges[model.amin :] = millimetres
    intensity[model.amin :] = np.where(millimetres > 0, seen.intensity, 0)
    first = np.where(ranges[:, 0] > 0, ranges[:, 0], no_return(model)).astype(np.int32)
    return FakeScan(first, intensity[:, 0].copy(), ranges[:, 1:].copy(), intensity[:, 1:].copy())
