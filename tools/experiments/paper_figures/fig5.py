"""The paper's second experiment (its Fig. 5): maps and ways by wheels alone, by other matchers, and by ours.

The paper's robot (180 deg, 721 beams, 40 Hz) drives 160 m and returns to its start: once up and down the paper's room
(`room`), once through the room into the 68 m corridor and back (`tour`). People walk about, one side of the room is
partly glass, wheels slip, lamps are 5 % off their data sheet, walls reflect; seeds change all chance. Then it drives
the first half of the way again under lamps that have aged. Matching and fusing are compared: no loops are closed.

Who has no light is told where it starts, and is scored as it stands. Who has light is told nothing: it is scored in the
survey's frame as published live, from 10 s after it was switched on.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from estimator.measurements import Beam, Scan
from estimator.paper import LUMILOOP
from estimator.paper.methods import Method
from tools.ci.figures import Figure
from tools.experiments.paper_figures.fig5_picture import Panel, draw_maps
from tools.experiments.support.outings import Outing, fresh, outing, play, reckoned
from tools.experiments.support.report import COMMAND, Cell, Picture, Report, Table, Work
from tools.experiments.support.trajectory import Array, Errors, Track, errors, fitted, started

SEEDS: Final = (1, 2, 3)
DRIVES: Final = ("room", "tour")
FROM_S: Final = 10.0
"""Light has told heading by then."""
AGEINGS: Final = (0.0, 0.1, 0.3)
MAP_S: Final = 0.5
"""For the picture of a map, a scan is kept every so often."""


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot under test. lit: whether it has the photodiode. method: its estimator, by name."""

    name: str
    lit: bool
    method: str


ROBOTS: Final = (
    Robot("pIC", False, "pic"),
    Robot("the paper's method, laser alone", False, "paper"),
    Robot("the paper's method, laser and lights", True, "paper"),
    Robot("ours, laser alone", False, LUMILOOP),
    Robot("ours, laser and lights", True, LUMILOOP),
)
MAIN: Final = ROBOTS[-1]
ALONE: Final = "lights and wheels, no laser"
WHEELS: Final = "wheels alone"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one drive with one seed gave.

    Attributes:
        tracks: by robot, scored part only, in the frame of the truth. kept: the same as the keyframes lie at the end.
        sketch: a few scans of both passes, for the picture of a map; empty but for the first seed.
    """

    where: str
    seed: int
    tracks: dict[str, Track]
    kept: dict[str, Track]
    sketch: tuple[Sketch, ...]


Sketch = tuple[float, Array]


def trial(task: tuple[str, int, float]) -> Outcome:
    """Both passes of one drive with one seed."""
    where, seed, seconds = task
    out = outing(where, seed, seconds)
    tracks, kept = {}, {}
    seen = out.scans(0)
    wheels, light, begin = out.odometry(0), out.light(0), min(FROM_S, 0.4 * out.seconds)
    main = None
    for robot in ROBOTS:
        one = fresh(out.run, robot.lit, robot.method)
        log = play(one, (wheels, seen, light) if robot.lit else (wheels, seen))
        found = log.tracks(one.state, out.run.truth)
        live, whole = found["live"], found["kept"]
        tracks[robot.name] = (live if robot.lit else started(live)).since(begin)
        kept[robot.name] = whole if robot.lit else started(whole)
        if robot is MAIN:
            main, tracks[ALONE] = one, known(found["lights"].since(begin))
            tracks[WHEELS] = kept[WHEELS] = reckoned(wheels, live.t, out.run.truth)
    sketch = tuple(sketched(seen)) if seed == SEEDS[0] else ()
    del seen
    assert main is not None
    sketch += second(out, main, begin, (tracks, kept))
    return Outcome(where, seed, tracks, kept, sketch)


def second(
    out: Outing, main: Method, begin: float, into: tuple[dict[str, Track], dict[str, Track]]
) -> tuple[Sketch, ...]:
    """The second pass under lamps of each age, driven on and switched on anew; the sketch of its scans."""
    tracks, kept = into
    seen, wheels, t0 = out.scans(1), out.odometry(1), out.span(1)[0]
    for share in AGEINGS:
        light, ways = out.light(1, share), [(carried_on(share), copy.deepcopy(main), 0.0)]
        if share == AGEINGS[-1]:
            ways.append((begun_anew(share), fresh(out.run, True), begin))
        for name, one, since in ways:
            found = play(one, (wheels, seen, light)).tracks(one.state, out.run.truth)
            tracks[name], kept[name] = found["live"].since(t0 + since), found["kept"]
            tracks[f"{name}, no laser"] = known(found["lights"].since(t0 + since))
    return tuple(sketched(seen)) if out.run.seed == SEEDS[0] else ()


def carried_on(share: float) -> str:
    """Name of a second pass by the robot of the first."""
    return f"second pass, lamps aged by {share:.0%}"


def begun_anew(share: float) -> str:
    """Name of a second pass by a robot that has just been switched on."""
    return f"switched on anew, lamps aged by {share:.0%}"


def known(track: Track) -> Track:
    """The part of a track where there is a pose."""
    some = np.isfinite(track.pose[:, 0])
    return Track(track.t[some], track.pose[some], track.truth[some])


def sketched(seen: Sequence[Scan]) -> list[Sketch]:
    """A few scans as points in the base frame, for the picture of a map."""
    out, last = [], -np.inf
    for scan in seen:
        if scan.t_end - last < MAP_S:
            continue
        last = scan.t_end
        hit = np.flatnonzero((scan.beam == Beam.HIT) & (scan.range_m < 20.0))[::4]
        x, y, yaw = scan.T_base_lidar
        a, r = scan.bearing_rad[hit] + yaw, scan.range_m[hit]
        out.append((scan.t_end, np.column_stack((x + r * np.cos(a), y + r * np.sin(a)))))
    return out


def judged(track: Track) -> tuple[Errors, float]:
    """Errors as it stands, and RMSE after the best fit, m."""
    return errors(track), errors(fitted(track)).rmse


def run(quick: bool, work: Work) -> Report:
    """Both drives over all seeds; with ``quick`` the first seconds of one."""
    seeds, drives, seconds = (SEEDS[:1], DRIVES[:1], 12.0) if quick else (SEEDS, DRIVES, np.inf)
    done = work.map(trial, [(where, seed, seconds) for where in drives for seed in seeds], "fig5")
    tables, figures, pictures = [], [], []
    for where in drives:
        mine = [outcome for outcome in done if outcome.where == where]
        tables.append(Table(f"{where}, cm (heading: deg), {len(seeds)} seeds", HEAD, tuple(rows_of(mine))))
        figures += figures_of(where, mine)
        pictures.append(Picture(f"fig5-{where}", partial(draw_maps, panels_of(mine[0]), where), SIZES[where]))
    return Report(tuple(figures), tuple(tables), tuple(pictures), tuple(seeds), NOTES)


SIZES: Final = {"room": (9.0, 7.3), "tour": (7.5, 13.0)}
HEAD: Final = (
    "", "rmse, median", "worst", "largest, median", "worst", "at the end, median", "worst", "heading rms, median",
    "fitted rmse, median", "as kept, median",
)  # fmt: skip
NOTES: Final = (
    "no loops are closed",
    "without light: the true start is given; with light: nothing is given, poses in the survey's frame, as published "
    "live, from 10 s after being switched on",
    "fitted: after the best rigid motion of the whole way; as kept: where the keyframes lie at the end, all of the way",
    "aged: every lamp's power has changed at once, up or down, by half to all of the share, unknown to the robot",
)


def rows_of(done: list[Outcome]) -> list[tuple[Cell, ...]]:
    """A line of the table for each robot: medians and worst over the seeds."""
    rows: list[tuple[Cell, ...]] = []
    for name in done[0].tracks:
        both = [judged(one.tracks[name]) for one in done if len(one.tracks[name].t)]
        kept = [100.0 * errors(one.kept[name]).rmse for one in done if name in one.kept]
        if not both:
            continue
        found, fits = [one[0] for one in both], [100.0 * one[1] for one in both]
        cells: list[Cell] = [name]
        for key in ("rmse", "largest", "end"):
            values = [100.0 * getattr(one, key) for one in found]
            cells += [float(np.median(values)), float(np.max(values))]
        cells += [float(np.median([one.heading for one in found])), float(np.median(fits))]
        rows.append((*cells, float(np.median(kept)) if kept else "-"))
    return rows


def figures_of(where: str, done: list[Outcome]) -> list[Figure]:
    """Median and worst absolute trajectory error of each robot."""
    out = []
    for name in done[0].tracks:
        values = [100.0 * errors(one.tracks[name]).rmse for one in done if len(one.tracks[name].t)]
        for word, value in (("median", np.median(values)), ("worst", np.max(values))) if values else ():
            out.append(
                Figure(f"{where}, {name}: trajectory RMSE, {word}", float(value), "cm", command=f"{COMMAND} fig5")
            )
    return out


def panels_of(outcome: Outcome) -> list[Panel]:
    """What is drawn: maps of the first pass, and of the second by a robot that is new under the oldest lamps."""
    names = [WHEELS, *(robot.name for robot in ROBOTS if "paper" not in robot.name or robot.lit)]
    names.append(begun_anew(AGEINGS[-1]))
    panels = []
    for name in names:
        track, rmse = outcome.kept[name], errors(outcome.tracks[name]).rmse
        points = [put(track, t, xy) for t, xy in outcome.sketch if track.t[0] - 1.0 < t < track.t[-1] + 1.0]
        panels.append(Panel(f"{name}\nRMSE {100.0 * rmse:.1f} cm", track, np.vstack([np.empty((0, 2)), *points])))
    return panels


def put(track: Track, t: float, points: Array) -> Array:
    """Points of the base frame where a track has the robot at an instant."""
    x, y, yaw = track.pose[int(np.argmin(np.abs(track.t - t)))].tolist()
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points @ np.array(((c, s), (-s, c))) + (x, y))
