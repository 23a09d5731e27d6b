"""The nearest-neighbour search alone: index and one pass, against comparing every pair in compiled code and a k-d tree.

Every pass is over scans of its own, many in turn: a processor that has seen the same pass before predicts its branches,
and such a time is half of what a robot gets. Of several times for the same pass the least counts.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Final

import numba
import numpy as np
from scipy.spatial import cKDTree

from estimator.measurements import Array
from estimator.numerics.arrays import Ints
from estimator.scan_matching import distance_region, nearest_neighbour
from estimator.scan_matching.distance_axis import FEWEST, Axis, build_axis, sector_count
from tools.bench.match import FAR, STILL, pairs, points
from tools.bench.support.scenes import Scene, corridor, office, paper_room, round_room
from tools.ci.figures import Figure, bounded

COMMAND: Final = "python -m tools.bench search"
CLOSE: Final = (0.001, 0.01)
SCANS, TIMES = 16, 5


@dataclass
class Task:
    """One pass: reference points, the axis' centre, queries; and room for the answer."""

    reference: Array
    queries: Array
    centre: Array = field(default_factory=lambda: STILL[:2])
    sectors: int = 0

    def __post_init__(self) -> None:
        self.axis = build_axis(self.reference, self.centre, self.sectors)
        self.tree = cKDTree(self.reference)
        self.local = np.ascontiguousarray(self.queries - self.centre)
        m = len(self.queries)
        self.row, self.visits = np.empty(m, np.int64), np.empty(m, np.int64)
        self.d2, self.e2 = np.empty(m), np.empty(m)

    def ours(self) -> None:
        """One pass."""
        axis, out = self.axis, (self.row, self.d2, self.e2, self.visits)
        nearest_neighbour.nearest_all(axis.rows, axis.start, axis.rays, self.local, np.inf, out)

    def index(self) -> Axis:
        """Our index."""
        return build_axis(self.reference, self.centre, self.sectors)

    def brute(self) -> None:
        """Every pair compared."""
        brute(self.axis.rows, self.local, self.row)


@numba.njit(fastmath=True)
def brute(rows: Array, queries: Array, found: Ints) -> None:
    """Every pair compared, compiled: what a search has to beat."""
    for i in range(len(queries)):
        best, at = np.inf, -1
        for j in range(len(rows)):
            d2 = (rows[j, 0] - queries[i, 0]) ** 2 + (rows[j, 1] - queries[i, 1]) ** 2
            if d2 < best:
                best, at = d2, j
        found[i] = at


def run() -> list[Figure]:
    """Rooms, what is hard, the paper's single axis, and where one form overtakes the other."""
    return [*_rooms(), *_hard(), *_paper_form(), *_crossover()]


def microseconds(work: Callable[[Task], object], tasks: list[Task], times: int = TIMES) -> float:
    """Median over the tasks of the least time, the tasks taken in turn."""
    least = np.full(len(tasks), np.inf)
    for _ in range(times):
        for i, task in enumerate(tasks):
            begin = time.perf_counter()
            work(task)
            least[i] = min(least[i], time.perf_counter() - begin)
    return 1e6 * statistics.median(least)


def tasks_of(scene: Scene, off: tuple[float, float], beams: int = 1081, sectors: int = 0) -> list[Task]:
    """Passes over a scene whose new scan is off by so much."""
    found = pairs(scene, beams, 270.0, off, SCANS)
    return [Task(points(p.reference), points(p.new), sectors=sectors) for p in found]


def compare(name: str, tasks: list[Task], least: str) -> list[Figure]:
    """Time, points visited, ratios; one set of tasks."""
    mine = microseconds(Task.ours, tasks)
    visits = float(np.mean([task.visits.mean() for task in tasks]))
    every = microseconds(Task.brute, tasks, 2)
    tree = microseconds(lambda task: task.tree.query(task.queries), tasks, 2)
    peer = f"cKDTree (scipy {version('scipy')})"
    return [
        Figure(f"pass, {name}: ours", mine, "us", command=COMMAND),
        Figure(f"pass, {name}: points visited per query", visits, "", command=COMMAND),
        bounded(f"pass, {name}: brute / ours", every / mine, "x", least, COMMAND),
        Figure(f"pass, {name}: {peer} / ours", tree / mine, "x", command=COMMAND),
    ]


def _rooms() -> list[Figure]:
    figures = []
    cases = {"17 cm / 4 deg": (FAR, ">= 8"), "converged": (CLOSE, ">= 25"), "1 m / 20 deg": ((1.0, 20.0), ">= 1")}
    for room, scene in (("paper room", paper_room()), ("office", office())):
        for name, (off, least) in cases.items():
            figures += compare(f"{room}, {name}", tasks_of(scene, off), least)
        tasks = tasks_of(scene, CLOSE)
        mine = microseconds(Task.index, tasks)
        tree = microseconds(lambda task: cKDTree(task.reference), tasks)
        figures.append(bounded(f"index of 1081 points, {room}: ours", mine, "us", "<= 30", COMMAND))
        figures.append(Figure(f"index of 1081 points, {room}: cKDTree / ours", tree / mine, "x", command=COMMAND))
    return figures


def _hard() -> list[Figure]:
    """Where a radial order has nothing to hold on to."""
    rng = np.random.default_rng(5)
    room = [points(p.reference) for p in pairs(paper_room(), 1081, 270.0, FAR, 4)]
    same = np.full((1081, 2), 2.0)
    away, none = np.array((60.0, 25.0)), STILL[:2]
    cases = {
        "circle, centred": tasks_of(round_room(), (0.02, 1.0)),
        "corridor 60 x 2 m, 17 cm / 4 deg": tasks_of(corridor(), FAR),
        "all points equal, queries elsewhere": [Task(same, scan) for scan in room],
        "all points and queries equal": [Task(same, same) for _ in range(4)],
        "axis centred 65 m away": [Task(scan, scan + 0.1, none - away) for scan in room],
        "queries 65 m away": [Task(scan, scan + away) for scan in room],
        "queries all about the centre": [Task(scan, rng.normal(0.0, 0.05, scan.shape)) for scan in room],
    }
    return [figure for name, tasks in cases.items() for figure in compare(name, tasks, ">= 1")]


def _paper_form() -> list[Figure]:
    """The paper's fused axis, pass for pass the same work: merging and search, and the search alone."""
    figures = []
    for name, off in (("converged", CLOSE), ("17 cm / 4 deg", FAR)):
        tasks = tasks_of(paper_room(), off, sectors=1)
        fused = {id(task): distance_region.fuse(task.axis, task.queries, STILL) for task in tasks}
        whole = microseconds(lambda task: distance_region.fuse(task.axis, task.queries, STILL), tasks)
        walk = microseconds(lambda task, at=fused: distance_region.pair_fused(task.axis, at[id(task)]), tasks)
        seen = [distance_region.pair_fused(task.axis, fused[id(task)])[2].mean() for task in tasks]
        figures += [
            Figure(f"fused axis, paper room, {name}: merging", whole, "us", command=COMMAND),
            Figure(f"fused axis, paper room, {name}: search", walk, "us", command=COMMAND),
            Figure(f"fused axis, paper room, {name}: points visited", float(np.mean(seen)), "", command=COMMAND),
        ]  # fmt: skip
    return figures


def _crossover() -> list[Figure]:
    """Index and one pass on the single axis, as multiples of the form that is chosen for so many points."""
    figures = []
    for beams in (4, 16, 32, 64, 128, 256, 512, 1081, 3001, 10_001):
        for name, off in (("converged", CLOSE), ("17 cm / 4 deg", FAR)):
            found = pairs(office(), beams, 270.0, off, 6)
            time_of = {}
            for sectors in (1, max(FEWEST, sector_count(beams))):
                tasks = [Task(points(p.reference), points(p.new), sectors=sectors) for p in found]
                time_of[sectors == 1] = microseconds(lambda t: (t.index(), t.ours()), tasks)
            label = f"index and pass, {beams} points, {name}"
            figures.append(Figure(f"{label}: sectors", time_of[False], "us", command=COMMAND))
            figures.append(
                Figure(f"{label}: single axis / sectors", time_of[True] / time_of[False], "x", "", None, COMMAND)
            )
    return figures
