"""Adaptive Link_n, the paper's future work, against every fixed number of links, in three buildings of the simulator.

In each building single positions are found along the robot's tour, with everything in the simulator that is not a
passer-by or sway: uneven lamps and floor, powers 5 % off, lean, walls, columns and shelves that stand in the way. Where
lamps stand in a line two places fit; a prior of 0.5 m chooses, for all alike. A position error of more than 3 m, or no
position, counts as 3 m: a robot would not believe it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from estimator.paper.lateration import Doubt, Prior, Solver, SolverSettings
from tools.ci.figures import Figure
from tools.experiments.support.places import CENTRED, Array, error, sheet_of, spots
from tools.experiments.support.report import COMMAND, Cell, Picture, Report, Table, Work
from tools.sim.building.buildings import building
from tools.sim.ceiling.ceiling import Ceiling, Effects
from tools.sim.ceiling.lamps import fixtures

FIXED: Final = (3, 4, 5, 6, 7, 8, None)
SOLVERS: Final = (Solver.LS, Solver.LIN, Solver.ML)
DOUBT: Final = Doubt(common_ln=0.05, tilt=0.02, floor=0.008, floor_own=0.01)
SIGMA_LN: Final = 0.05
PRIOR_M: Final = 0.5
WORST_M: Final = 3.0
RESAMPLES: Final = 2000


@dataclass(frozen=True, slots=True)
class Room:
    """Where to drive. ``zone``: only places and lamps of this part. ``seeds``: how many ceilings."""

    name: str
    zone: tuple[float, float, float, float] | None = None
    seeds: int = 6


ROOMS: Final = (
    Room("paper_room", (-5.0, -5.0, 5.0, 5.0)),
    Room("corridor_loop"),
    Room("warehouse_hall", seeds=3),  # 60 lamps over racks: a minute each
)


def tour(room: Room, count: int) -> Array:
    """(n, 2) places evenly along the building's tour, at most ``count``, within the zone."""
    corners = np.array(building(room.name).route.corners)
    corners = np.vstack([corners, corners[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    at = np.linspace(0.0, length[-1], count, endpoint=False)
    xy = np.column_stack([np.interp(at, length, corners[:, 0]), np.interp(at, length, corners[:, 1])])
    if room.zone is None:
        return xy
    x0, y0, x1, y1 = room.zone
    return xy[(xy[:, 0] > x0) & (xy[:, 0] < x1) & (xy[:, 1] > y0) & (xy[:, 1] < y1)]


def trial(job: tuple[int, int, bool]) -> Array:
    """(solvers, fixed numbers and adaptive, places) errors in m of one building (index) with one seed.

    Quickly: few places, and no light by way of the walls.
    """
    number, seed, quick = job
    room, place = ROOMS[number], building(ROOMS[number].name)
    lamps = tuple(f for f in fixtures(place) if room.zone is None or f.zone == room.zone)
    effects = Effects(people=False, sway=False, bounces=0 if quick else 1)
    ceiling = Ceiling(lamps, place.world, place.height_m, effects, CENTRED, seed=seed)
    sheet, rng = sheet_of(ceiling, SIGMA_LN), np.random.default_rng((seed, number, 2))
    met = spots(ceiling, sheet, tour(room, 24 if quick else 160), rng, beyond=True)
    priors = [Prior(spot.xy + PRIOR_M * rng.standard_normal(2), PRIOR_M**2 * np.eye(2)) for spot in met]
    rows = []
    for solver in SOLVERS:
        base = SolverSettings(solver, None, doubt=DOUBT)
        methods = [*(replace(base, link_n=n) for n in FIXED), replace(base, adaptive=True)]
        rows.append([
            [error(spot, sheet, method, prior) for spot, prior in zip(met, priors, strict=True)] for method in methods
        ])  # fmt: skip
    errors: Array = np.fmin(np.array(rows), WORST_M)
    return errors


Statistic = Callable[[Array], Any]


def rms(errors: Array) -> Any:
    """Root mean square along the last axis."""
    return np.sqrt(np.mean(errors**2, axis=-1))


def median(errors: Array) -> Any:
    """Along the last axis."""
    return np.median(errors, axis=-1)


def compared(errors: Array, statistic: Statistic, rng: np.random.Generator) -> tuple[int, float, float, float]:
    """Adaptive (last row) against the best fixed number, (numbers + 1, places).

    Returns:
        index of the best fixed number; ratio adaptive / best; 95 % interval of that ratio by resampling places, the
        best number chosen afresh each time (the choice is part of the chance).
    """
    values = statistic(errors)
    best = int(np.argmin(values[:-1]))
    ratios = []
    for _ in range(RESAMPLES):
        again = statistic(errors[:, rng.integers(errors.shape[1], size=errors.shape[1])])
        ratios.append(again[-1] / np.min(again[:-1]))
    low, high = np.percentile(ratios, (2.5, 97.5))
    return best, float(values[-1] / values[best]), float(low), float(high)


def run(quick: bool, work: Work) -> Report:
    """Errors by number of links in each building and what the adaptive choice does there."""
    jobs = [(number, seed, quick) for number, room in enumerate(ROOMS) for seed in range(1 if quick else room.seeds)]
    found = work.map(trial, jobs, "buildings")
    tables, figures, rng = [], [], np.random.default_rng(9)
    drawn: dict[str, Array] = {}
    for number, room in enumerate(ROOMS):
        errors = 100.0 * np.concatenate([e for job, e in zip(jobs, found, strict=True) if job[0] == number], axis=2)
        drawn[room.name] = errors
        for name, statistic in (("median", median), ("rms", rms)):
            tables.append(
                _table(f"{room.name}, {name} position error, cm ({errors.shape[2]} places)", errors, statistic, rng)
            )
        for solver, rows in zip(SOLVERS, errors, strict=True):
            for name, statistic in (("median", median), ("rms", rms)):
                values = statistic(rows)
                ratio = float(values[-1] / values[:-1].min())
                figures.append(
                    Figure(
                        f"{room.name}, {solver.value}: adaptive over best fixed, {name}", ratio, "ratio", "<= 1",
                        round(ratio, 3) <= 1.0, f"{COMMAND} adaptive",
                    )
                )  # fmt: skip
    notes = (
        "fixed n: the n shortest links above 0.6 of the strength at the edge of view; all: every such link",
        "interval: 95 % of the ratio adaptive / best fixed number, places drawn again with replacement",
    )
    return Report(
        tuple(figures),
        tuple(tables),
        (Picture("adaptive", _drawing(drawn), (9.0, 3.6)),),
        tuple(range(1 if quick else 6)),
        notes,
    )


def _table(title: str, errors: Array, statistic: Statistic, rng: np.random.Generator) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for solver, lines in zip(SOLVERS, errors, strict=True):
        best, ratio, low, high = compared(lines, statistic, rng)
        shown = [float(v) for v in statistic(lines)]
        rows.append((solver.value, *shown, _label(FIXED[best]), ratio, f"{low:.2f} to {high:.2f}"))
    head = ("", *(_label(n) for n in FIXED), "adaptive", "best fixed", "ratio", "interval")
    return Table(title, head, tuple(rows))


def _label(n: int | None) -> str:
    return "all" if n is None else str(n)


def _drawing(drawn: dict[str, Array]) -> Callable[[Any], None]:
    def draw(canvas: Any) -> None:
        for axes, (name, errors) in zip(canvas.subplots(1, len(drawn)), drawn.items(), strict=True):
            at = range(len(FIXED))
            for solver, rows in zip(SOLVERS, errors, strict=True):
                values = median(rows)
                (line,) = axes.plot(at, values[:-1], marker="o", label=solver.value)
                axes.axhline(values[-1], linestyle="--", linewidth=1.0, color=line.get_color())
            axes.set(title=name, xticks=list(at), xticklabels=[_label(n) for n in FIXED], ylim=(0, None))
            axes.set(xlabel="number of links (dashed: adaptive)", ylabel="median error, cm")
            axes.grid(alpha=0.3)
            axes.legend(fontsize="small")

    return draw
