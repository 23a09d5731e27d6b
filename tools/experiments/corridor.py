"""Along a corridor under one row of lamps, at most 3 m apart: how far off along it, and how far it would have to be.

Nothing along these walls tells one metre from the next; the laser knows the distance from them and the heading, light
the place along. Three drives: through the paper's room, 47 m along its corridor (lamps 2.72 m apart) and back;
switched on in that corridor, along it and back; twice round a block (`corridor_loop`, lamps 2.9 m apart), switched on
in it. Loops are closed, as the daemon does. Scored is the pose as published live, along the corridor, from 10 s after
setting off (at the corridor's end a robot turns round first, under two lamps, which are too few for a start), and
beside it the Cramer-Rao bound of the same stretch (`corridor_bound`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from estimator.light_filter.light_channel import LightsSetup
from estimator.numerics import se2
from estimator.pipeline import State, new_state
from estimator.result import StepResult
from tools.ci.figures import Figure, bounded
from tools.experiments.corridor_bound import Sizes, bound, seen
from tools.experiments.support.loop_drives import BODY, half, play, scans
from tools.experiments.support.report import COMMAND, Cell, Picture, Report, Table, Work
from tools.sim.building.buildings import building
from tools.sim.building.world import Array
from tools.sim.ceiling.movers import lean_of
from tools.sim.light.link_drive import LightRun, tour_run
from tools.sim.robot.drive import Drive, Route

SEEDS: Final = (1, 2, 3)
FROM_S: Final = 10.0
SET_OFF_M: Final = 0.1
NO_CORRIDOR: Final = -1
UP_AND_DOWN: Final = Route(
    ((-6.15, -10.0), (-6.15, 40.0), (-6.6, 41.2), (-6.15, 42.2), (-5.7, 41.2), (-6.15, 40.0)), 0.6
)
"""Along the paper's corridor, round a keyhole, and back."""
CORNER_M: Final = 3.0


@dataclass(frozen=True, slots=True)
class Case:
    """A drive: its building, way and number of laps."""

    name: str
    place: str
    route: Route | None = None
    laps: int = 1


CASES: Final = (
    Case("from the room into the corridor and back", "paper_room"),
    Case("switched on in the corridor", "paper_room", UP_AND_DOWN),
    Case("switched on in a corridor round a block, twice round", "corridor_loop", None, 2),
)


def drive_of(case: Case, seed: int) -> LightRun:
    """A case with one seed."""
    place = building(case.place)
    place = place if case.route is None else replace(place, route=case.route)
    run = tour_run(case.place, None, seed, None, place)
    drive = Drive(place.route, BODY, 2.0, case.laps)
    run.ceiling.lean = lean_of(drive)
    return replace(run, drive=drive, seconds=case.laps * drive.lap_s)


def axis_of(case: Case, truth: Array) -> Array:
    """(n,) of which coordinate runs along the corridor where the robot is; NO_CORRIDOR at corners and in rooms."""
    x, y = truth[:, 0], truth[:, 1]
    if case.place == "paper_room":
        return np.where((x < -5.5) & (y > -11.0) & (y < 39.5), 1, NO_CORRIDOR)
    low, high = CORNER_M, np.array((40.0, 25.0)) - CORNER_M
    lies = (y < 2.2) | (y > 25.0 - 2.2)
    along_x, along_y = lies & (x > low) & (x < high[0]), ~lies & (y > low) & (y < high[1])
    return np.where(along_x, 0, np.where(along_y, 1, NO_CORRIDOR))


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a drive came to; arrays by scan, from `FROM_S` on, where there is a corridor.

    Attributes:
        t: s. along, across, turned: errors, m, m, rad. sigma: what was said of along. light: error along of
            the `lights` filter, laser left out. floor: the bound on along, m, from the first epoch in that corridor.
    """

    t: Array
    along: Array
    across: Array
    turned: Array
    sigma: Array
    light: Array
    floor: Array


def trial(task: tuple[Case, int, float]) -> Outcome:
    """One drive with one seed, for so many seconds at most."""
    case, seed, seconds = task
    run = drive_of(case, seed)
    run = replace(run, seconds=min(run.seconds, seconds))
    light = half(run.light())
    rows: list[Array] = []

    def watch(state: State, result: StepResult, done: list[tuple[Any, Any]]) -> None:
        T = se2.compose(result.T_map_odom, result.T_odom_base)
        lit = np.full(3, np.nan) if result.lights is None else result.lights.T_map_base
        rows.append(np.concatenate(((result.t_mono,), T, lit, np.diag(result.covariance))))

    play(new_state(None, LightsSetup(run.survey, clock_ppm=0.0)), (run.odometry(), scans(run), light), watch)
    table = np.array(rows)
    truth = run.truth(table[:, 0])
    axis = axis_of(case, truth)
    begun = table[np.argmax(np.hypot(*(truth[:, :2] - truth[0, :2]).T) > SET_OFF_M), 0]
    some = (axis >= 0) & (table[:, 0] >= begun + min(FROM_S, 0.3 * seconds))
    table, truth, axis = table[some], truth[some], axis[some]
    at = np.arange(len(axis))
    off, by_light = table[:, 1:4] - truth, table[:, 4:7] - truth
    floor = floor_of(case, run, light)
    return Outcome(
        table[:, 0], off[at, axis], off[at, 1 - axis], np.angle(np.exp(1j * off[:, 2])),
        np.sqrt(table[at, 7 + axis]), by_light[at, axis], np.interp(table[:, 0], *floor),
    )  # fmt: skip


def floor_of(case: Case, run: LightRun, light: Sequence[Any]) -> tuple[Array, Array]:
    """Instants and the bound there, stretch by stretch: what the one before has taught of its lamps is forgotten."""
    t = np.array([epoch.t_end for epoch in light])
    truth = run.truth(t)
    axis = axis_of(case, truth)
    fx = run.ceiling.effects
    gain = math.hypot(fx.gain_spread, fx.receiver_gain)
    sizes = Sizes(gain, math.radians(fx.lamp_tilt_deg), fx.survey_m, run.wheels.scale, run.wheels.noise)
    stamps, values = [], []
    for k in np.split(np.arange(len(t)), 1 + np.flatnonzero(np.diff(axis) != 0)):
        if axis[k[0]] < 0 or len(k) < 20:
            continue
        epochs = [seen(light[i], truth[i], run.survey, int(axis[k[0]])) for i in k]
        stamps.append(t[k])
        values.append(bound(epochs, sizes))
    return np.concatenate(stamps), np.concatenate(values)


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def run(quick: bool, work: Work) -> Report:
    """All drives with all seeds; with ``quick`` the first seconds of one."""
    seeds, cases, seconds = (SEEDS[:1], CASES[1:2], 25.0) if quick else (SEEDS, CASES, math.inf)
    tasks = [(case, seed, seconds) for case in cases for seed in seeds]
    done = work.map(trial, tasks, "corridor")
    rows, figures = [], []
    for n, case in enumerate(cases):
        mine = done[n * len(seeds) : (n + 1) * len(seeds)]
        rows.append(row_of(case, mine))
        worst = 100.0 * max(rms(one.along) for one in mine)
        figures.append(bounded(f"{case.name}: along, worst", worst, "cm", "<= 5", f"{COMMAND} corridor"))
        floor = 100.0 * max(rms(one.floor) for one in mine)
        figures.append(Figure(f"{case.name}: bound on that", floor, "cm", command=f"{COMMAND} corridor"))
    pictures = (Picture("corridor", partial(draw, list(zip(cases, done[:: len(seeds)], strict=True))), (8.0, 7.0)),)
    return Report(tuple(figures), (Table("Along a corridor, cm", HEAD, tuple(rows)),), pictures, tuple(seeds), NOTES)


HEAD: Final = (
    "", "along rms, median", "worst", "largest", "said, rms", "bound, rms", "lights alone", "across rms",
    "heading, deg",
)  # fmt: skip
NOTES: Final = (
    "from 10 s after setting off, where there is a corridor on both sides; as published live",
    "bound: Cramer-Rao, for a robot that knows its distance from the walls, its heading, and how walls reflect",
)


def row_of(case: Case, done: list[Outcome]) -> tuple[Cell, ...]:
    """A line of the table."""
    along = [rms(one.along) for one in done]
    cells = [
        float(np.median(along)), max(along), max(float(np.abs(one.along).max()) for one in done),
        float(np.median([rms(one.sigma) for one in done])), float(np.median([rms(one.floor) for one in done])),
        float(np.median([rms(one.light) for one in done])), float(np.median([rms(one.across) for one in done])),
    ]  # fmt: skip
    turned = float(np.degrees(np.median([rms(one.turned) for one in done])))
    return (case.name, *(100.0 * cell for cell in cells), turned)


def draw(done: list[tuple[Case, Outcome]], figure: Any) -> None:
    """Error along over time, what was said of it, and the bound."""
    panels = figure.subplots(len(done), 1, squeeze=False)[:, 0]
    for axes, (case, one) in zip(panels, done, strict=True):
        axes.plot(one.t, 100.0 * one.along, ".", ms=2, color="tab:red", label="error along the corridor")
        for sign in (-1.0, 1.0):
            axes.plot(
                one.t, sign * 200.0 * one.sigma, ".", ms=1, color="tab:blue", label="published 2 sigma" * (sign > 0)
            )
            axes.plot(
                one.t, sign * 200.0 * one.floor, ".", ms=1, color="black", label="2 sigma, least possible" * (sign > 0)
            )
        axes.axhspan(-5.0, 5.0, color="0.9", zorder=0, label="5 cm")
        axes.set_title(case.name, fontsize=9)
        axes.set_ylabel("along the corridor, cm")
        axes.set_ylim(-50.0, 50.0)
    panels[0].legend(fontsize=8, markerscale=6, ncols=4, loc="upper center")
    panels[-1].set_xlabel("seconds since being switched on")
