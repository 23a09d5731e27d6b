"""One scenario through the daemon's own cycle in virtual time: what was published, against the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from heapq import merge
from typing import Final

import numpy as np

from daemon.config.schema import LidarConfig, Mount
from daemon.devices.conversion import SampleBridge, ScanBridge
from daemon.devices.photodiode import BlockWatch
from daemon.runtime.budget import FixedBudget
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import Parts
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot
from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.epoch import LightEpoch
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_snapshot import MapImage
from estimator.numerics import se2
from estimator.pipeline import Settings, new_state, step
from estimator.pipeline import State as EstimatorState
from estimator.stored_map import image_of, restored
from hal.adc import AdcStatus, Blemish, RawSamples
from hal.imu import RawImu
from hal.lidar import VALID, LidarGeometry, LidarStatus, Link, RawScan
from hal.odometry import RawOdometry
from tools.experiments.integrity.scene import FIRST_S, Scenario
from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.building.people import Crowd
from tools.sim.building.world import Array

PERIOD_S: Final = 0.1
DELAY_S: Final = 0.003
"""From a sensor's last word to the cycle."""
MOUNT: Final = (0.15, 0.0, 0.0)
WORDS: Final = np.full(1111, 2048, dtype=np.uint16)
COLUMNS: Final = (
    "t", "state", "reason", "error_m", "error_rad", "sigma_m", "sigma_rad", "bound_m", "bound_rad", "deviations",
    "gap", "light_off_m", "jumps",
)  # fmt: skip
"""Of a track: one row a cycle; a bound that there is not is inf. ``deviations``: of the error, by its covariance."""


class Clock:
    """Virtual time that the run sets."""

    def __init__(self) -> None:
        self.t = 0.0

    def now(self) -> float:
        """See :class:`hal.clock.Clock`."""
        return self.t

    def utc(self) -> float:
        """See :class:`hal.clock.Clock`."""
        return self.t


class _Decoded(SampleBridge):
    """Puts what a decoder would have said in the place of each block."""

    def __init__(self) -> None:
        super().__init__(PROFILE_A)
        self.waiting: dict[int, LightEpoch] = {}

    def block(self, raw: RawSamples) -> LightEpoch:  # type: ignore[override]  # `step` takes either
        """An epoch for each block."""
        return self.waiting.pop(raw.seq)


@dataclass(slots=True, eq=False)
class Robot:
    """A daemon's cycle with virtual devices about it."""

    cycle: Cycle
    clock: Clock
    decoded: _Decoded | None
    state: EstimatorState

    def take(self, arrived: tuple[float, object]) -> Snapshot | None:
        """One thing that arrives; a scan starts a cycle."""
        self.clock.t, thing = arrived
        inbox = self.cycle.inbox
        if isinstance(thing, RawOdometry):
            inbox.put_odometry(thing)
        elif isinstance(thing, RawImu):
            inbox.put_imu(thing)
        elif isinstance(thing, LightEpoch):
            assert self.decoded is not None
            seq, watch = len(self.decoded.waiting) + self.cycle.blocks + 1000, self.cycle.parts.blocks
            self.decoded.waiting[seq] = thing
            inbox.put_samples(
                RawSamples(seq, thing.t_begin, thing.t_end, thing.t_begin, 22222.2, WORDS, 12, Blemish(0))
            )
            assert watch is not None
        elif isinstance(thing, RawScan):
            inbox.put_scan(thing)
            return self.cycle.run()
        return None


def robot_of(scene: Scenario, image: MapImage | None = None) -> Robot:
    """A robot that has just been switched on, with a map or without."""
    clock, lit = Clock(), scene.told is not None
    setup = LightsSetup(scene.told, PROFILE_A, 0.0) if scene.told is not None else None
    state = new_state(Settings(), setup) if image is None else restored(image, Settings(), setup)
    decoded = _Decoded() if lit else None
    parts = Parts(
        clock=clock,
        step=partial(step, state),
        scans=ScanBridge(LidarConfig(mount=Mount(*MOUNT))),
        budget=FixedBudget(),
        worker=CycleWorker(),
        status=LidarStatus(link=Link.STREAMING),
        odometry=scene.wheels,
        samples=decoded,
        blocks=BlockWatch(AdcStatus(), PROFILE_A) if lit else None,
    )
    return Robot(Cycle(parts), clock, decoded, state)


def geometry_of(scene: Scenario) -> LidarGeometry:
    """A lidar of that many beams over that angle, looking ahead."""
    between = scene.beams - 1
    ares = 360.0 * between / scene.fov_deg
    return LidarGeometry(
        "UTM-30LX", "integrity", "0", ares, 0.5 * between, 0, between, 23, 60000, 0.001, PERIOD_S, PERIOD_S / ares
    )


def scans(scene: Scenario) -> Iterator[RawScan]:
    """What the lidar sends, revolution after revolution; nothing but errors while it is covered."""
    geometry = geometry_of(scene)
    sweep_s = geometry.beam_dt_s * (scene.beams - 1)
    sweep = Sweep(geometry.bearings(0, 1, scene.beams), 0.0, sweep_s)
    scanner, crowd = Scanner(scene.place.world, sweep, UTM_30LX, scene.seed), Crowd(scene.place.walkers)

    def lidar(at: Array) -> Array:
        T = scene.pose(at)
        c, s = np.cos(T[:, 2]), np.sin(T[:, 2])
        return np.column_stack([T[:, 0] + c * MOUNT[0], T[:, 1] + s * MOUNT[0], T[:, 2] + scene.turned(at)])

    for k in range(int((scene.seconds - sweep_s) / PERIOD_S)):
        t = k * PERIOD_S
        if t < FIRST_S or any(t < off < t + sweep_s for off in scene.restarts):
            continue  # nobody has seen half of a scan before the robot was switched off, and the rest after
        legs = crowd.legs(t, scene.pose(np.array([t]))[0])
        posture = Posture(0.3, *scene.tilt(t))
        ranges = np.rint(1000.0 * scanner.measure(t, lidar, legs, posture).range_m[:, 0]).astype(np.int32)
        if any(since <= t < until for since, until in scene.blind):
            ranges[:] = 0
        code = np.where((ranges >= geometry.dmin) & (ranges <= geometry.dmax), VALID, 0).astype(np.int32)
        yield RawScan(geometry, k, t + sweep_s + 0.002, t, 0.0005, k, 0, 1, ranges, code)


def arrivals(scene: Scenario) -> Iterator[tuple[float, object]]:
    """Everything that reaches the daemon, in order."""
    streams: list[Iterator[tuple[float, object]]] = [((scan.t_rx + DELAY_S, scan) for scan in scans(scene))]
    if scene.wheels:
        streams.append((reading.t_rx, reading) for reading in scene.odometry())
    if scene.ceilings:
        streams.append((epoch.t_end + DELAY_S, epoch) for epoch in scene.light())
    return merge(*streams, key=lambda arrived: arrived[0])


ANYWHERE: Final = 1e6
"""Variance that stands for none: the place is being looked for."""


def run(scene: Scenario) -> Array:
    """(cycles, columns) track of one scenario, see :data:`COLUMNS`."""
    robot = robot_of(scene)
    start = se2.identity() if scene.lit else scene.pose(np.zeros(1))[0]
    rows, off = [], list(scene.restarts)
    for arrived in arrivals(scene):
        if off and arrived[0] >= off[0]:
            del off[0]
            robot = robot_of(scene, image_of(robot.state))
        snapshot = robot.take(arrived)
        if snapshot is not None and snapshot.pose is not None:
            true = se2.between(start, scene.pose(np.array([snapshot.t_mono]))[0])
            rows.append(row(snapshot, true))
    return np.array(rows)


def row(snapshot: Snapshot, true: Array) -> list[float]:
    """One row of a track: a snapshot with a pose, against the truth."""
    assert snapshot.pose is not None
    e = np.array(snapshot.pose) - true
    e[2] = se2.wrap(float(e[2]))
    xx, xy, yy, xt, yt, tt = snapshot.covariance or (ANYWHERE, 0.0, ANYWHERE, 0.0, 0.0, ANYWHERE)
    P = np.array(((xx, xy, xt), (xy, yy, yt), (xt, yt, tt)))
    largest = np.sqrt(max(np.linalg.eigvalsh(P[:2, :2])[-1], 0.0))
    trust, light = snapshot.trust, snapshot.light
    off = np.hypot(*(np.array(light.pose[:2]) - true[:2])) if light is not None and light.pose is not None else np.nan
    deviations = float(np.sqrt(max(e @ np.linalg.solve(P + 1e-12 * np.eye(3), e), 0.0)))
    return [
        snapshot.t_mono, float(snapshot.state), float(snapshot.reason), float(np.hypot(*e[:2])), abs(float(e[2])),
        float(largest), float(np.sqrt(max(tt, 0.0))),
        np.inf if trust.horizontal_m is None else trust.horizontal_m,
        np.inf if trust.yaw_rad is None else trust.yaw_rad,
        deviations, np.nan if trust.gap is None else trust.gap, float(off), float(snapshot.jumps),
    ]  # fmt: skip
