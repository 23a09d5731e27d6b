"""The paper's claim: T1 from light makes the search short, and fusing it is no extra burden.

The same scans are matched from three ideas of the motion (see `claim_pairs`), by our point-to-line matcher (axes of
sectors, safe radius) and by the paper's (closed form point-to-point, one merged axis), each told how uncertain that
idea is. Times are processor time of the match alone, taken in turn in one process; index and light not included.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.mapping.keyframe import keep
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.paper import registration
from estimator.paper.first_transform import First
from estimator.paper.point_to_point import CENTRE
from estimator.paper.pose_weighting import Weight
from estimator.scan_matching import local_map, scan_matcher
from estimator.scan_matching.deskew import oriented, points_of, unturned
from estimator.scan_matching.distance_axis import build_axis
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.local_map import LocalMap
from estimator.scan_matching.scan_matcher import Attempt, MatchSettings, Prior, View
from tools.ci.figures import Figure
from tools.experiments.paper_figures.claim_cost import Effort, effort_of, timed
from tools.experiments.paper_figures.claim_cycle import HEAD as CYCLE_HEAD
from tools.experiments.paper_figures.claim_cycle import burden
from tools.experiments.paper_figures.claim_pairs import (
    GOOD,
    IDEAS,
    SLIPPING,
    Condition,
    Pair,
    apart,
    drive_of,
    lit_only,
    pairs_of,
    returns,
    way_of,
)
from tools.experiments.support.report import COMMAND, Cell, Report, Table, Work
from tools.experiments.support.trajectory import Array

CONDITIONS: Final = (
    Condition("room, 0.5 m/s", "room", 0.5, GOOD),
    Condition("room, 1 m/s", "room", 1.0, GOOD),
    Condition("room, 0.5 m/s, slip", "room", 0.5, SLIPPING),
    Condition("office, 0.6 m/s", "office", 0.6, GOOD),
    Condition("office, 0.6 m/s, slip", "office", 0.6, SLIPPING),
)
GAPS: Final = (("next scan", 0.025), ("0.5 s later", 0.5), ("back after 20 m", None))
COUNT: Final = 40
SEED: Final = 1
FAR_M, QUALITY, NOISE_M = 80.0, 0.0, 0.01
CAP: Final = 50
CLOSE_M, CLOSE_RAD = 0.02, np.radians(0.5)
"""A match that comes closer than this to the truth has succeeded."""
LEAST: Final = np.array((0.002, 0.002, 0.001))
"""No idea is said to be better than this (m, m, rad)."""
STILL: Final = np.zeros(3)
SETTINGS: Final = MatchSettings()
PAPER: Final = registration.PointToPoint(FAR_M, Weight.INFORMATION)

Matcher = Callable[[Pair, Prior], "Asked"]


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """A match ready to be made. ``make``: makes it and returns the pose; ``told``: its effort, made once more."""

    make: Callable[[], Array]
    told: Callable[[], Effort]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one match: error of the idea and of the result (m, rad), effort, milliseconds, points matched."""

    idea: tuple[float, float]
    error: tuple[float, float]
    effort: Effort
    ms: float
    points: int

    @property
    def close(self) -> bool:
        """Whether the match succeeded."""
        return self.error[0] <= CLOSE_M and self.error[1] <= CLOSE_RAD


def map_of(reference: Scan, moved: Array) -> LocalMap:
    """Line elements of one scan in its own base frame, on their axes."""
    points = points_of(reference, moved, FAR_M, QUALITY)
    lines = lines_of(points)
    elements = np.zeros((len(lines), local_map.WIDTH))
    elements[:, : local_map.SLOPE + 1], elements[:, local_map.WEIGHT] = lines[:, :5], 1.0
    frame = keep(0, STILL, STILL, reference, points.turned_rad)
    return local_map.index(elements, frame.T_odom_lidar[:2], 1, frame)


def view_of(new: Scan, moved: Array) -> View:
    """The scan to be matched, put straight."""
    points = points_of(new, moved, FAR_M, QUALITY)
    beams = (unturned(new.bearing_rad, points.turned_rad), new.range_m, new.beam)
    return View(oriented(points, 100_000), new.T_base_lidar, beams, NOISE_M)


def by_lines(pair: Pair, prior: Prior) -> Asked:
    """Our matcher."""
    local, view = map_of(pair.reference, pair.moved[0]), view_of(pair.new, pair.moved[1])
    axis = (local.axis.rows, local.axis.start, local.axis.rays)

    def make(tried: list[Attempt] | None = None) -> Array:
        return scan_matcher.match(view, local, prior, CAP, SETTINGS, tried).T_odom_base

    def told() -> Effort:
        tried: list[Attempt] = []
        make(tried)
        parts = [effort_of(one.view.points, axis, one.trace, keeps=True) for one in tried]
        return sum(parts[1:], parts[0])

    return Asked(make, told)


def by_points(pair: Pair, prior: Prior) -> Asked:
    """The paper's matcher; its axis is built with every match."""
    view = view_of(pair.new, pair.moved[1])
    frame = keep(0, STILL, STILL, pair.reference, points_of(pair.reference, pair.moved[0], FAR_M, QUALITY).turned_rad)
    first = First(prior.T, prior.L)

    def make() -> Attempt:
        return PAPER.attempt(view, frame, first, CAP, SETTINGS)

    def told() -> Effort:
        axis = build_axis(registration.points_of(frame, FAR_M), CENTRE, sectors=1)
        return effort_of(view.points, (axis.rows, axis.start, axis.rays), make().trace, keeps=False)

    return Asked(lambda: make().T, told)


MATCHERS: Final[dict[str, Matcher]] = {"ours": by_lines, "the paper's": by_points}


def uncertainty(pairs: list[Pair], idea: str) -> Array:
    """Information of an idea: from its errors over these pairs, root mean square along each axis."""
    off = np.array([error_of(pair, pair.ideas[idea]) for pair in pairs])
    return np.asarray(np.diag(np.maximum(np.sqrt(np.mean(off**2, axis=0)), LEAST) ** -2.0))


def error_of(pair: Pair, T: Array) -> Array:
    """Of a motion, along the true frame's axes (3,)."""
    off = se2.between(pair.truth, T)
    off[2] = se2.wrap(off[2])
    return off


def outcomes(pairs: list[Pair], matcher: Matcher) -> dict[str, list[Outcome]]:
    """All pairs from all ideas, in turn."""
    sure = {idea: uncertainty(pairs, idea) for idea in IDEAS}
    out: dict[str, list[Outcome]] = {idea: [] for idea in IDEAS}
    for pair in pairs:
        asked = [matcher(pair, Prior(pair.ideas[idea], sure[idea])) for idea in IDEAS]
        for idea, one, ms in zip(IDEAS, asked, timed([one.make for one in asked]), strict=True):
            before, after = (error_of(pair, T) for T in (pair.ideas[idea], one.make()))
            lengths = [(float(np.hypot(*e[:2])), float(abs(e[2]))) for e in (before, after)]
            out[idea].append(Outcome(*lengths, one.told(), ms, int(np.count_nonzero(pair.new.beam))))
    return out


HEAD: Final = (
    "drive", "scans", "T1 from", "T1 off, cm", "deg", "success", "iterations", "look-ups", "visits", "ms",
)  # fmt: skip


def row_of(names: tuple[str, str, str], found: list[Outcome]) -> tuple[Cell, ...]:
    """A line of the table: medians over the pairs, share of success; look-ups and visits per point matched."""

    def middle(values: list[float]) -> float:
        return float(np.median(values))

    return (
        *names,
        middle([100.0 * one.idea[0] for one in found]),
        middle([np.degrees(one.idea[1]) for one in found]),
        float(np.mean([one.close for one in found])),
        middle([one.effort.iterations for one in found]),
        middle([one.effort.sought / one.points for one in found]),
        middle([one.effort.visits / one.points for one in found]),
        middle([one.ms for one in found]),
    )


def trial(task: tuple[Condition, int, float]) -> dict[str, tuple[tuple[Cell, ...], ...]]:
    """All gaps of one condition: the table's rows, by matcher."""
    condition, count, seconds = task
    run, laser = drive_of(condition, SEED, seconds)
    way, rows = way_of(run), {name: list[tuple[Cell, ...]]() for name in MATCHERS}
    for gap, after in GAPS:
        which = returns(run, laser, count) if after is None else apart(run, laser, after, count)
        pairs = pairs_of(run, laser, way, lit_only(way, which, laser.model.true_period_s))
        for name, matcher in MATCHERS.items() if pairs else ():
            found = outcomes(pairs, matcher)
            rows[name] += [row_of((condition.name, f"{gap} ({len(pairs)})", idea), found[idea]) for idea in IDEAS]
    return {name: tuple(lines) for name, lines in rows.items()}


def run(quick: bool, work: Work) -> Report:
    """All conditions; with ``quick`` a few pairs of the first one."""
    conditions, count, seconds = (CONDITIONS[:1], 3, 15.0) if quick else (CONDITIONS, COUNT, np.inf)
    done = work.map(trial, [(condition, count, seconds) for condition in conditions], "claim")
    tables = [
        Table(
            f"{name} matcher: medians; look-ups and visits per point of the scan",
            HEAD,
            sum((d[name] for d in done), ()),
        )
        for name in MATCHERS
    ]
    cost = burden(2.0 if quick else 30.0, SEED)
    tables.append(Table("a cycle of step, ms of processor time", CYCLE_HEAD, cost))
    figures = [
        Figure(
            f"fusing light, {row[0]}: mean per cycle beyond laser alone",
            float(row[-1]),
            "ms",
            command=f"{COMMAND} claim",
        )
        for row in cost[1:]
    ]
    return Report(tuple(figures), tuple(tables), (), (SEED,), NOTES)


NOTES: Final = (
    "success: within 2 cm and 0.5 deg of the truth; look-ups: nearest-neighbour searches; visits: reference points "
    "compared; all over the whole match",
    "back after 20 m: the reference is an earlier scan from within 0.4 m; `none` is then told that it is there",
    "pairs of which light did not know both poses are left out: the paper pauses light there",
    "times: processor time; ours without its index, which all scans of a keyframe share, the paper's with its axis",
)
