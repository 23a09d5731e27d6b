"""Loops in a corridor round a block, twice round (240 m), under all lamps and under fewer, wrong or ambiguous ones.

Nothing along these corridors tells one metre from the next but their corners; one row of lamps, at most 2.9 m apart,
hangs above. Reported: loops with precision and recall (definitions: fig6_truth), the error of the published pose, along
the corridor and in all, and that of the map's keyframes as they lie at the end. `light factors off` takes what light
said of the submaps out of the pose graph (and out of the judgement of loops).
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from heapq import merge
from typing import Any, Final

import numpy as np

from daemon.integrity.observer import Observer
from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import Job, Record, Scan
from estimator.pipeline import Settings, State, keyframe_poses, new_state
from estimator.result import StepResult
from tools.ci.figures import Figure, bounded
from tools.experiments.paper_figures.fig6_curves import Point, counted
from tools.experiments.paper_figures.fig6_trial import FROM_S, Watcher
from tools.experiments.relocation.trial import Moment, Robot, Said, longest
from tools.experiments.support.loop_drives import BODY, RATE_HZ, half, scans
from tools.experiments.support.report import COMMAND, Report, Table, Work
from tools.experiments.support.trajectory import Errors, Track, errors, started
from tools.sim.building.buildings import building
from tools.sim.building.world import Array
from tools.sim.ceiling.ceiling import Ceiling, Effects
from tools.sim.ceiling.lamps import Fixture, fixtures, with_codes
from tools.sim.ceiling.links import Reception
from tools.sim.ceiling.movers import lean_of
from tools.sim.ceiling.records import survey
from tools.sim.light.link_drive import LightRun
from tools.sim.robot.drive import Drive
from tools.sim.robot.odometry import Wheels

SEEDS: Final = (1, 2, 3)
LAPS: Final = 2
ISLANDS: Final = ((20.0, 1.1), (38.9, 16.0), (8.0, 23.9))
ISLAND_M: Final = 5.0
CODES: Final = 6
DEAD: Final = 0.3
MOVED: Final = ((3, (0.8, 0.0)), (18, (0.0, -0.8)))
"""Lamps that hang elsewhere than the survey says, and by how much."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is wrong with the lamps. lit: whether there is a photodiode. factors: whether the graph hears of light."""

    name: str
    lit: bool = True
    islands: bool = False
    dead: bool = False
    moved: bool = False
    reused: bool = False
    factors: bool = True


CASES: Final = (
    Case("laser alone", lit=False),
    Case("all lamps"),
    Case("all lamps, light factors off", factors=False),
    Case("three islands of lamps", islands=True),
    Case("30 % dead", dead=True),
    Case("two moved by 0.8 m", moved=True),
    Case("six codes for all lamps", reused=True),
    Case("islands, 30 % dead, two moved, codes reused", islands=True, dead=True, moved=True, reused=True),
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a drive came to.

    Attributes:
        along: RMSE in the driving direction, m. live: as published; kept: of the keyframes.
        tracking: share of the time in which TRACKING was said. astray_s: longest time for which it was with a pose off
            by more than 0.5 m or 5 deg. sure: largest error (m) in TRACKING.
    """

    loops: Point
    along: float
    live: Errors
    kept: Errors
    tracking: float = math.nan
    astray_s: float = math.nan
    sure: float = math.nan


@dataclass(eq=False)
class Judged(Robot):
    """A robot as the daemon judges it; ``done``: jobs of the latest cycle with what they have found."""

    done: list[tuple[Any, Any]] = field(default_factory=list)

    def take(self, t: float, records: list[Record]) -> StepResult:
        """One cycle; what it asks for is done at once, and answered with the next."""
        result = super().take(t, records)
        self.done = [(job, job.run()) for job in self.waiting]
        return result

    def _run(self, job: Job) -> object:
        return next(payload for one, payload in self.done if one is job)


def driven(
    robot: Judged, streams: Iterable[Iterable[Record]], watch: Callable[..., None], run: LightRun
) -> list[Moment]:
    """All records through the robot, one cycle a scan; what was said after each."""
    pending: list[Record] = []
    moments = []
    ordered: Iterable[Any] = merge(*streams, key=lambda record: record.t_end)  # type: ignore[union-attr]  # no orders
    for record in ordered:
        pending.append(record)
        if isinstance(record, Scan):
            result = robot.take(record.t_end, pending)
            pending = []
            watch(robot.state, result, robot.done)
            moments.append(robot.moment(record.t_end, run.truth(np.array([robot.t_mono]))[0]))
    return moments


def ceiling_for(case: Case, seed: int) -> Ceiling:
    """The lamps as they are; the survey is made of what was planned."""
    place = building("corridor_loop")
    planned: tuple[Fixture, ...] = fixtures(place)
    if case.islands:
        planned = tuple(f for f in planned if min(math.hypot(f.x - x, f.y - y) for x, y in ISLANDS) < ISLAND_M)
    if case.islands or case.reused:
        planned = with_codes(planned, CODES) if case.reused else with_codes(planned)
    return Ceiling(planned, place.world, place.height_m, Effects(), seed=seed)


def spoiled(case: Case, ceiling: Ceiling, seed: int) -> Ceiling:
    """Lamps that the survey does not know to be dead or elsewhere."""
    count = len(ceiling.fixtures)
    if case.moved:
        for number, by in MOVED:
            ceiling = ceiling.moved(1 + (number - 1) % count, by)
    if case.dead:
        for k in np.random.default_rng((seed, 5)).permutation(count)[: round(DEAD * count)]:
            ceiling.switch_off(ceiling.fixtures[int(k)].lamp_id)
    return ceiling


def drive_of(case: Case, seed: int) -> LightRun:
    """Twice round the block."""
    place, ceiling = building("corridor_loop"), ceiling_for(case, seed)
    told = survey(ceiling)
    drive = Drive(place.route, BODY, 2.0, LAPS)
    ceiling = spoiled(case, ceiling, seed)
    ceiling.lean = lean_of(drive)
    return LightRun(drive, ceiling, told, Wheels(), place.world, seed, LAPS * drive.lap_s, Reception())


def without_light(watch: Callable[..., None]) -> Callable[..., None]:
    """Keep from the graph what light says of submaps."""

    def seen(state: State, result: StepResult, done: list[tuple[Any, Any]]) -> None:
        for submap in state.map.graph.submaps.values():
            submap.light = None
        watch(state, result, done)

    return seen


def trial(task: tuple[Case, int, float]) -> Outcome:
    """One case with one seed."""
    case, seed, seconds = task
    run = drive_of(case, seed)
    run = replace(run, seconds=min(run.seconds, seconds))
    state = new_state(Settings(history=True), LightsSetup(run.survey, clock_ppm=0.0) if case.lit else None)
    watch = Watcher(run, False)
    streams = (run.odometry(), scans(run), half(run.light())) if case.lit else (run.odometry(), scans(run))
    robot = Judged(state, Observer(0.0, odometry=True, lidar=True, lights=case.lit), period_s=1.0 / RATE_HZ)
    moments = driven(robot, streams, watch if case.factors else without_light(watch), run)
    t = np.array(watch.t)
    live = Track(t, np.array(watch.pose), run.truth(t))
    live = live.since(min(FROM_S, 0.3 * seconds)) if case.lit else started(live)
    laid = sorted(watch.truth.pose)
    where = keyframe_poses(state)
    kept = Track(
        np.array(laid, float), np.array([where[k] for k in laid]), np.array([watch.truth.pose[k] for k in laid])
    )
    loops = Point(*counted(watch.loops, watch.asked))
    found = Outcome(loops, along(live), errors(live), errors(kept if case.lit else started(kept)))
    if not case.lit:
        return found  # whose map has a frame of its own
    tracking = [one for one in moments if one.state == Said.TRACKING]
    share = len(tracking) / len(moments)
    sure = max((one.off_m for one in tracking), default=0.0)
    return replace(found, tracking=share, astray_s=longest(moments, [one.astray for one in moments]), sure=sure)


def along(track: Track) -> float:
    """RMSE in the direction in which the robot truly looks: along the corridor, but for the corners."""
    off: Array = track.pose[:, :2] - track.truth[:, :2]
    ahead = np.column_stack((np.cos(track.truth[:, 2]), np.sin(track.truth[:, 2])))
    return float(np.sqrt(np.mean(np.sum(off * ahead, axis=1) ** 2)))


def run(quick: bool, work: Work) -> Report:
    """All cases over all seeds; with ``quick`` the first seconds of two."""
    seeds, cases, seconds = (SEEDS[:1], CASES[:2], 20.0) if quick else (SEEDS, CASES, math.inf)
    done = work.map(trial, [(case, seed, seconds) for case in cases for seed in seeds], "islands")
    rows, figures = [], []
    for n, case in enumerate(cases):
        mine = done[n * len(seeds) : (n + 1) * len(seeds)]
        rows.append(row_of(case, mine))
        if case.name == "all lamps":
            worst = 100.0 * max(one.along for one in mine)
            figures.append(
                bounded("corridors, lamps 2.9 m apart: along, worst", worst, "cm", "<= 5", f"{COMMAND} islands")
            )
        if case.lit:
            astray = max(one.astray_s for one in mine)
            figures.append(
                bounded(f"{case.name}: TRACKING wrongly, longest", astray, "s", "<= 0.5", f"{COMMAND} islands")
            )
    figures += [
        Figure(f"corridors, {row[0]}: RMSE, median", float(row[6]), "cm", command=f"{COMMAND} islands") for row in rows
    ]
    return Report(tuple(figures), (Table("Corridors round a block, twice", HEAD, tuple(rows)),), (), tuple(seeds))


HEAD: Final = (
    "", "loops", "precision %", "recall %", "along, median cm", "worst", "RMSE, median cm", "worst", "heading, deg",
    "map RMSE, median cm", "worst", "TRACKING, %", "wrongly, longest s", "largest error in TRACKING, cm",
)  # fmt: skip


def row_of(case: Case, done: list[Outcome]) -> tuple[str | float | int, ...]:
    """A line of the table."""
    p = Point(*np.sum([(o.loops.accepted, o.loops.right, o.loops.queries, o.loops.got) for o in done], axis=0).tolist())
    ahead, live, kept = [o.along for o in done], [o.live.rmse for o in done], [o.kept.rmse for o in done]
    cells = [100.0 * v for part in (ahead, live) for v in (float(np.median(part)), max(part))]
    heading = float(np.median([o.live.heading for o in done]))
    last = [100.0 * float(np.median(kept)), 100.0 * max(kept)]
    said = [100.0 * float(np.median([o.tracking for o in done])), max(o.astray_s for o in done)]
    said.append(100.0 * max(o.sure for o in done))
    return (case.name, p.accepted, 100.0 * p.precision, 100.0 * p.recall, *cells, heading, *last, *said)
