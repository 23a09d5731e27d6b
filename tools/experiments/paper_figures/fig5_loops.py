"""The final maps of Fig. 5 with loops closed: 160 m in the paper's room, by the laser alone and with lights.

A drive as those of Fig. 6, as slow as the paper's robot, with light twenty times a second. The map is what the kept
keyframes see from where they lie at the end; a line joins each keyframe that was found again with the submap it was
found in.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.keyframe import points_of_frame
from estimator.numerics import se2
from estimator.pipeline import Settings, keyframe_poses, new_state
from tools.ci.figures import bounded
from tools.experiments.paper_figures.fig5_picture import POINTS, POSE, TRUTH, VIEWS, name_axes, name_lines, walls
from tools.experiments.paper_figures.fig6_curves import right
from tools.experiments.paper_figures.fig6_trial import FROM_S, LASER, LIT, Watcher
from tools.experiments.support.loop_drives import SIGMA_M, play, room_drive, scans
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work
from tools.experiments.support.trajectory import Errors, Track, errors, started
from tools.sim.building.world import Array
from tools.sim.light.link_drive import ROOM_BODY, ROOM_WALKERS

SEEDS: Final = (1, 2, 3)
LENGTH_M: Final = 160.0


@dataclass(frozen=True, slots=True, eq=False)
class Ending:
    """How a drive ended. points: of the map; loops: (n, 2, 2) from keyframe to submap; in the frame of the truth."""

    name: str
    live: Errors
    wrong: int
    track: Track
    points: Array
    loops: Array


def trial(task: tuple[str, int, float]) -> Ending:
    """One drive by one robot."""
    name, seed, length_m = task
    run, lit = room_drive(seed, length_m, ROOM_BODY), name == LIT
    state = new_state(Settings(history=True), LightsSetup(run.survey, clock_ppm=0.0) if lit else None)
    watch = Watcher(run, False)
    seen, wheels = scans(run, ROOM_WALKERS), run.odometry()
    play(state, (wheels, seen, run.light()) if lit else (wheels, seen), watch)
    live = Track(np.array(watch.t), np.array(watch.pose), run.truth(np.array(watch.t)))
    where = keyframe_poses(state)
    keys = sorted(watch.truth.pose)
    T = np.zeros(3) if lit else se2.compose(watch.truth.pose[keys[0]], se2.inverse(where[keys[0]]))
    placed = np.array([se2.compose(T, where[key]) for key in keys])
    kept = Track(np.array(keys, float), placed, np.array([watch.truth.pose[key] for key in keys]))
    at = dict(zip(keys, placed, strict=True))
    points = [se2.apply(at[frame.key], points_of_frame(frame, SIGMA_M).xy) for frame in state.map.keyframes.values()]
    first = watch.truth.member
    loops = [(at[one.query][:2], at[first[one.submap][0]][:2]) for one in watch.loops]
    judged = errors(live.since(FROM_S) if lit else started(live))
    wrong = sum(not right(one) for one in watch.loops)
    return Ending(name, judged, wrong, kept, np.vstack(points), np.array(loops).reshape(-1, 2, 2))


def run(quick: bool, work: Work) -> Report:
    """Three drives by both robots; with ``quick`` one short one."""
    seeds, length = (SEEDS[:1], 30.0) if quick else (SEEDS, LENGTH_M)
    done = work.map(trial, [(name, seed, length) for name in (LASER, LIT) for seed in seeds], "fig5_loops")
    rows = []
    for one, seed in zip(done, seeds * 2, strict=True):
        live, kept = one.live, 100.0 * errors(one.track).rmse
        lengths = [100.0 * v for v in (live.rmse, live.largest, live.end)]
        rows.append((f"{one.name}, seed {seed}", *lengths, live.heading, kept, len(one.loops), one.wrong))
    lit = [one.live for one in done if one.name == LIT]
    worst, turned = 100.0 * max(one.rmse for one in lit), max(one.heading for one in lit)
    command = f"{COMMAND} fig5_loops"
    figures = (
        bounded("160 m with lights, loops closed: trajectory RMSE, worst", worst, "cm", "<= 3", command),
        bounded("160 m with lights, loops closed: heading RMS, worst", turned, "deg", "<= 0.3", command),
    )
    table = Table("160 m, loops closed, as published live; cm, deg", HEAD, tuple(rows))
    picture = Picture("fig5-loops", partial(draw, [done[0], done[len(seeds)]]), (9.0, 5.3))
    return Report(figures, (table,), (picture,), tuple(seeds))


HEAD: Final = ("", "rmse", "largest", "at the end", "heading rms", "keyframes at the end, rmse", "loops", "wrong")


CLOSED: Final = {"ls": "-", "lw": 0.4, "color": "tab:green", "label": "closed loop"}


def draw(done: list[Ending], canvas: Any) -> None:
    """Both maps with their loops."""
    for axes, one in zip(canvas.subplots(1, len(done)), done, strict=True):
        walls(axes, False)
        axes.plot(*one.points.T, **POINTS)
        axes.plot(*one.track.truth[:, :2].T, **TRUTH)
        axes.plot(*one.track.pose[:, :2].T, **POSE)
        for a, b in one.loops:
            axes.plot((a[0], b[0]), (a[1], b[1]), **CLOSED)
        name_axes(axes)
        left, right_, bottom, top = VIEWS["room"]
        axes.set(xlim=(left, right_), ylim=(bottom, top), aspect="equal")
        axes.set_title(f"{one.name}: RMSE {100.0 * one.live.rmse:.1f} cm, {len(one.loops)} loops", fontsize=8)
    name_lines(canvas, 5, CLOSED)
