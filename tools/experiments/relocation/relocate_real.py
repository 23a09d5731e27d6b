"""Switched on anywhere, with real scans: the first half of a recorded drive is the map, the second half asks.

The Intel Research Lab's log (SICK LMS, 180 beams). Short runs of consecutive scans with their odometry begin at random
instants of its second half, each with a robot that has just been switched on. Lamps are made up: one every 1.8 m along
the way, over a ceiling that no one has seen; walls, as the laser mapped them, stand in their light. The truth is the
run's own final trajectory over the whole log, corrected by all its loops; the map was made of the first half alone,
under these lamps, so its frame is theirs. Places that the first half has not seen are asked for too, and told apart.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from daemon.config.schema import LidarConfig
from daemon.devices.conversion import OdometryBridge, ScanBridge
from daemon.integrity.observer import Observer
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_snapshot import MapImage
from estimator.measurements import Array, LightEpoch, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, State, keyframe_poses, new_state
from estimator.stored_map import image_of
from hal.odometry import RawOdometry
from hal.replay.carmen import read_carmen
from tools.ci.figures import Figure, bounded
from tools.experiments.relocation.maps import pickled, unpickled
from tools.experiments.relocation.relocate import FOLDER, digest
from tools.experiments.relocation.trial import Case, Moment, Outcome, Robot, outcome, switched_on
from tools.experiments.support.proof import proved_share
from tools.experiments.support.report import COMMAND, Report, Skipped, Table, Work
from tools.sim.building.world import Plan
from tools.sim.ceiling.ceiling import Ceiling, Effects
from tools.sim.ceiling.lamps import Fixture, with_codes
from tools.sim.ceiling.records import epochs, survey
from tools.sim.hybrid import Trajectory

LOG: Final = "intel/intel.clf.gz"
PERIOD_S: Final = 0.2
SPACING_M: Final = 1.8
WALL_M: Final = 0.2
TRIALS: Final = 200
KNOWN_M, KNOWN_RAD = 1.0, 1.05
"""A place counts as mapped if the first half passed within this of it and looked within 60 deg of the same way: a lidar
that sees half the horizon has never seen what is behind it."""
EFFECTS: Final = Effects(bounces=0, people=False, sway=False)


@dataclass(frozen=True, slots=True)
class Kind:
    """Queries of one kind: their name, whether lamps are on, for how long each is watched, and which part of all."""

    name: str
    lit: bool
    seconds: float
    share: float


KINDS: Final = (
    Kind("real, lit", True, 5.0, 1.0),
    Kind("real, lit, 30 s", True, 30.0, 0.15),
    Kind("real, dark, 30 s", False, 30.0, 0.05),
)

Batch = tuple[Scan, list[Record]]


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """Scans of the log, each with the records since the one before, itself the last."""

    batches: list[Batch]

    @property
    def stamps(self) -> Array:
        """(n,) ends of the scans."""
        return np.array([scan.t_end for scan, _ in self.batches])


@cache
def log_of() -> Log:
    """The log.

    Raises:
        Skipped: it is not there.
    """
    root = os.environ.get("LUMILOOP_DATA")
    if root is None or not (Path(root) / LOG).is_file():
        raise Skipped(f"LUMILOOP_DATA must name the folder that holds {LOG} (see docs/data.md)")
    log = read_carmen(Path(root) / LOG)
    wheels, bridge = OdometryBridge(), ScanBridge(LidarConfig())
    bridge.T_base_lidar = np.array(log.mount)
    batches: list[Batch] = []
    due: list[Record] = []
    for event in log.events(0.0):
        if isinstance(event, RawOdometry):
            moved = wheels.increment(event)
            due += [] if moved is None else [moved]
            continue
        scan = bridge.scan(event)
        batches.append((scan, [*due, scan]))
        due = []
    return Log(evened(batches))


def evened(batches: list[Batch]) -> list[Batch]:
    """The same records in an even rhythm.

    The log's own stamps run backwards and come in bunches; at their word the robot drives at up to 90 m/s. A lidar
    and wheels alone bear that, since nothing is compared between two scans; light made up for such a drive would be
    that of a robot which jumps, and no receiver could have seen it.
    """
    stamps = np.array([scan.t_end for scan, _ in batches])
    even = np.linspace(stamps[0], stamps[-1], len(stamps))
    made = []
    for _, records in batches:
        moved: list[Record] = []
        for one in records:
            assert isinstance(one, Odometry | Scan)
            begin, end = np.interp((one.t_begin, one.t_end), stamps, even).tolist()
            moved.append(replace(one, t_begin=begin, t_end=end))
        last = moved[-1]
        assert isinstance(last, Scan)
        made.append((last, moved))
    return made


def driven(robot: Robot, batches: list[Batch], light: Iterator[LightEpoch] | None = None) -> list[tuple[int, Array]]:
    """Drive through the batches; anchor and pose relative to it after each."""
    hung = []
    epoch = None if light is None else next(light, None)
    for scan, records in batches:
        more: list[Record] = []
        while light is not None and epoch is not None and epoch.t_end <= scan.t_end:
            more.append(epoch)
            epoch = next(light, None)
        result = robot.take(scan.t_end, [*more, *records])
        hung.append((result.anchor, result.T_anchor_base))
    while robot.waiting:
        robot.take(batches[-1][0].t_end, [])
    return hung


def robot_of(state: State) -> Robot:
    """A robot at the log's begin."""
    return Robot(state, Observer(0.0, odometry=True, lights=state.light is not None), period_s=PERIOD_S)


def reference() -> tuple[Array, Array, Array]:
    """Stamps and final poses of the whole log, and places (n, 2) of what stands about."""
    log = log_of()
    robot = robot_of(new_state(Settings(history=True)))
    hung = driven(robot, log.batches)
    frames = keyframe_poses(robot.state)
    poses = np.array([se2.compose(frames[anchor], T) for anchor, T in hung])
    walls = [
        se2.apply(submap.T_map_submap, submap.settled.elements[:, :2].astype(np.float64))
        for submap in robot.state.map.graph.submaps.values()
        if submap.settled is not None
    ]
    cells = np.unique(np.round(np.vstack(walls) / WALL_M).astype(np.int64), axis=0)
    return log.stamps, poses, np.asarray(WALL_M * cells, dtype=np.float64)


def lamps_over(poses: Array) -> tuple[Fixture, ...]:
    """Lamps over the way, so that none hangs in a wall or behind one, each at least `SPACING_M` from all others."""
    at = np.zeros((0, 2))
    for place in poses[::5, :2]:
        if not len(at) or np.hypot(*(at - place).T).min() >= SPACING_M:
            at = np.vstack((at, place))
    return with_codes(Fixture(x, y, 2.9, (x - 2.5, y - 2.5, x + 2.5, y + 2.5)) for x, y in at.tolist())


def ceiling_over(poses: Array, walls: Array) -> Ceiling:
    """The lamps along a way, and what stands in their light."""
    clear = walls[[np.hypot(*(poses[:, :2] - wall).T).min() > 0.3 for wall in walls]]  # who passed by is no wall
    plan = Plan()
    for x, y in clear.tolist():
        plan.circle((x, y), 0.5 * WALL_M)
    return Ceiling(lamps_over(poses), plan.build(), 3.0, EFFECTS, seed=1)


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What all queries share: truth, lamps, the map of the first half, and the first half's way."""

    truth: Trajectory
    walls: Array
    image: MapImage
    half: int

    def mapped(self, pose: Array) -> bool:
        """Whether the first half has passed here, looking the same way."""
        passed = self.truth.poses[: self.half]
        near = np.hypot(*(passed[:, :2] - pose[:2]).T) < KNOWN_M
        return bool((near & (np.cos(passed[:, 2] - pose[2]) > np.cos(KNOWN_RAD))).any())


@cache
def ceiling() -> Ceiling:
    """The lamps, one for each process."""
    ground = ground_of()
    return ceiling_over(ground.truth.poses, ground.walls)


def setup() -> LightsSetup:
    """The photodiode."""
    return LightsSetup(survey(ceiling()), clock_ppm=0.0)


@cache
def ground_of() -> Ground:
    """Reference and map, made once and kept."""
    path = FOLDER / f"real-{digest()}.map"
    if path.exists():
        found = unpickled(path)
        assert isinstance(found, Ground)
        return found
    stamps, poses, walls = reference()
    truth, half = Trajectory(stamps, poses), len(stamps) // 2
    the = ceiling_over(poses, walls)
    robot = robot_of(new_state(None, LightsSetup(survey(the), clock_ppm=0.0)))
    driven(robot, log_of().batches[:half], epochs(the, truth.at, (float(stamps[0]), float(stamps[half - 1])), 1))
    ground = Ground(truth, walls, image_of(robot.state), half)
    pickled(path, ground)
    return ground


def attempt(task: tuple[int, int]) -> Outcome:
    """One query: seed, and which of the kinds."""
    seed, kind = task[0], KINDS[task[1]]
    ground, log = ground_of(), log_of()
    rng = np.random.default_rng((seed, 9))
    stamps = log.stamps
    last = int(np.searchsorted(stamps, stamps[-1] - kind.seconds)) - 1
    begin = int(rng.integers(ground.half, last))
    end = int(np.searchsorted(stamps, stamps[begin] + kind.seconds))
    t0 = float(log.batches[begin][0].t_begin)
    robot = switched_on(ground.image, setup() if kind.lit else None, t0, PERIOD_S)
    moments = asked(robot, begin, end, light_of(kind.lit, t0, float(stamps[end]), seed))
    known = ground.mapped(ground.truth.at(np.array([t0]))[0])
    return outcome(Case(kind.name, False, True, kind.seconds), seed, t0, moments, (known, 0), robot.slowest_job_s)


def light_of(lit: bool, t0: float, t1: float, seed: int) -> Iterator[LightEpoch]:
    """What the photodiode says between two instants."""
    return epochs(ceiling(), ground_of().truth.at, (t0 - 0.2, t1), seed) if lit else iter(())


def asked(robot: Robot, begin: int, end: int, light: Iterator[LightEpoch]) -> list[Moment]:
    """What a robot says at each scan from ``begin`` to ``end``; of the way before the first it knows nothing."""
    truth, batches = ground_of().truth, log_of().batches
    pending = next(light, None)
    moments = []
    for k in range(begin, end):
        scan, records = batches[k]
        records = [one for one in records if k > begin or not isinstance(one, Odometry)]
        more: list[Record] = []
        while pending is not None and pending.t_end <= scan.t_end:
            more.append(pending)
            pending = next(light, None)
        robot.take(scan.t_end, [*more, *records])
        moments.append(robot.moment(scan.t_end, truth.at(np.array([robot.t_mono]))[0]))
    return moments


def run(quick: bool, work: Work) -> Report:
    """Queries with and without light; with ``quick`` nothing: the log alone takes a minute."""
    log_of()
    if quick:
        raise Skipped("the map alone takes a minute; there is no quick part of it")
    FOLDER.mkdir(parents=True, exist_ok=True)
    ground_of()
    rows, figures = [], []
    for number, kind in enumerate(KINDS):
        name, seeds = kind.name, range(max(2, round(kind.share * (work.trials or TRIALS))))
        mine = work.map(attempt, [(seed, number) for seed in seeds], name, FOLDER / f"real-{digest()}")
        for known in (True, False):
            part = [one for one in mine if one.unique == known]
            rows += [row_of(f"{name}, {'mapped' if known else 'not mapped'}", part)] if part else []
        figures += figures_of(name, mine)
    return Report(tuple(figures), (Table("Real scans: where am I?", HEAD, tuple(rows)),), (), (), NOTES)


HEAD: Final = (
    "", "queries", "right in 1 s, %", "at the end, %", "not yet, %", "wrong at the end", "off > 1 m or 15 deg",
    "TRACKING wrongly", "slowest job, ms", "right, median s",
)  # fmt: skip
NOTES: Final = (
    "truth: the run's own final trajectory over the whole log; lamps are made up along it",
    "stamps of the log are put in an even rhythm: at their word a seventh of all increments is faster than 5 m/s",
    "each query is 5 or 30 s of the second half, some 25 or 150 scans, with its odometry",
    "right: 20 cm and 3 deg, from then on to the end",
    "mapped: the first half passed within 1 m of where it begins, and looked within 60 deg of the same way",
)


def row_of(title: str, found: list[Outcome]) -> tuple[str | float | int, ...]:
    """A line of the table."""
    n = len(found)
    hidden = sum(one.end in ("AMBIGUOUS", "RELOCATING", "LOST", "STARTING") for one in found)
    right = sum(one.ended_right for one in found)
    return (
        title, n, 100.0 * sum(one.right_s is not None and one.right_s <= 1.0 for one in found) / n, 100.0 * right / n,
        100.0 * hidden / n, n - right - hidden, sum(one.far_s > 0.0 for one in found),
        sum(one.astray_s > 0.0 for one in found), 1e3 * max(one.job_s for one in found),
        float(np.median([one.right_s for one in found if one.right_s is not None] or [np.nan])),
    )  # fmt: skip


def figures_of(name: str, found: list[Outcome]) -> list[Figure]:
    """What the project has bounds for."""
    n, far = len(found), sum(one.far_s > 0.0 for one in found)
    known = [one for one in found if one.unique]
    command = f"{COMMAND} relocate_real"
    out = []
    if name == KINDS[0].name and known:
        right = 100.0 * sum(one.ended_right for one in known) / len(known)
        out = [bounded(f"{name}: right at the end, of {len(known)} in what is mapped", right, "%", ">= 97", command)]
    return [
        *out,
        bounded(f"{name}: off by > 1 m or 15 deg, of {n}", float(far), "", "<= 0", command),
        Figure(f"{name}: off by so much, less than (95 %)", 100.0 * proved_share(far, n), "%", command=command),
    ]
