"""Long corridors of equal doors by the laser alone: how many loops are wrong, and how far off poses are that are near.

Drives of 0.95 km through `tools.sim.building.doors`, by wheels that are off by 1 to 2 %. Scored are pairs of keyframes
as they lie at the end, at most 2 m apart in truth and more than 15 m of way apart (what the relations of recorded logs
are about), and loops that became constraints.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from estimator.light_filter.survey import Survey
from estimator.numerics import se2
from estimator.pipeline import Settings, keyframe_poses, new_state
from tools.ci.figures import bounded
from tools.experiments.paper_figures.fig6_curves import right
from tools.experiments.paper_figures.fig6_trial import Watcher
from tools.experiments.support.loop_drives import play, scans
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work
from tools.sim.building.buildings import building
from tools.sim.building.doors import Kind, doors
from tools.sim.building.world import Array
from tools.sim.ceiling.ceiling import ceiling_of
from tools.sim.ceiling.links import Reception
from tools.sim.light.link_drive import LightRun
from tools.sim.robot.drive import Body, Drive
from tools.sim.robot.odometry import Wheels

CASES: Final = {
    "one door in 4 open, 2.6 m wide": Kind(2.6, 4),
    "one door in 17 open, 2.6 m wide": Kind(2.6, 17),
    "one door in 10 open, 5 m wide": Kind(5.0, 10),
}
SEEDS: Final = (1, 2)
WHEELS: Final = Wheels(rate_hz=20.0, scale=0.012, base_scale=0.02)
BODY: Final = Body(speed=0.9)
NEAR_M: Final = 2.0
APART_M: Final = 15.0
EVERY: Final = 3
"""Of the keyframes, for pairs: there are some thousands."""


@dataclass(frozen=True, slots=True, eq=False)
class Ending:
    """How a drive ended: way, m; loops, and wrong ones; errors of pairs, m and rad; keyframes' poses and true ones."""

    way_m: float
    loops: int
    wrong: int
    off_m: Array
    off_rad: Array
    pose: Array
    truth: Array


def trial(task: tuple[str, int, float]) -> Ending:
    """One drive, for so many seconds at most."""
    name, seed, seconds = task
    place = doors(CASES[name], seed)
    drive = Drive(place.route, BODY, 2.0, 1)
    unlit = ceiling_of(building("corridor_loop"))  # a drive has one; nobody looks up
    run = LightRun(drive, unlit, Survey(), WHEELS, place.world, seed, min(seconds, drive.lap_s), Reception())
    state, watch = new_state(Settings(history=True)), Watcher(run, False)
    play(state, (run.odometry(), scans(run, place.people)), watch)
    where = keyframe_poses(state)
    keys = [key for key in sorted(watch.truth.pose) if key in where][::EVERY]
    pose, truth = (np.array([poses[key] for key in keys]) for poses in (where, watch.truth.pose))
    way = np.array([watch.truth.way[key] for key in keys])
    near = np.hypot(*(truth[:, None, :2] - truth[None, :, :2]).transpose(2, 0, 1)) <= NEAR_M
    pairs = np.argwhere(near & (way[:, None] - way[None, :] > APART_M))
    off = [se2.between(se2.between(truth[j], truth[i]), se2.between(pose[j], pose[i])) for i, j in pairs]
    table = np.array(off).reshape(-1, 3)
    wrong = sum(not right(one) for one in watch.loops)
    return Ending(
        float(drive.travelled(np.array([run.seconds]))[0]), len(watch.loops), wrong,
        np.hypot(table[:, 0], table[:, 1]), np.abs(table[:, 2]), pose, truth,
    )  # fmt: skip


def run(quick: bool, work: Work) -> Report:
    """Each building with each seed; with ``quick`` the first two minutes of one."""
    tasks = [(name, seed, 120.0 if quick else np.inf) for name in CASES for seed in SEEDS][: 1 if quick else None]
    done = work.map(trial, tasks, "doors")
    rows = [
        (f"{name}, seed {seed}", one.way_m, one.loops, one.wrong, len(one.off_m), *(
            (float(one.off_m.mean()), float(np.degrees(one.off_rad.mean())), float(one.off_m.max()))
            if len(one.off_m) else (np.nan, np.nan, np.nan)
        ))
        for (name, seed, _), one in zip(tasks, done, strict=True)
    ]  # fmt: skip
    figures = tuple(
        bounded(
            f"{name}: mean error of pairs, worst seed",
            max(float(one.off_m.mean()) for (other, _, _), one in zip(tasks, done, strict=True) if other == name),
            "m", "<= 0.045", f"{COMMAND} doors",
        )
        for name in CASES
        if any(other == name and len(one.off_m) for (other, _, _), one in zip(tasks, done, strict=True))
    )  # fmt: skip
    table = Table("loops, and pairs of keyframes that are near", HEAD, tuple(rows))
    pictures = (Picture("doors", partial(draw, tasks, done), (9.0, 3.0 * ((len(done) + 1) // 2))),)
    return Report(figures, (table,), pictures, SEEDS)


HEAD: Final = ("", "way, m", "loops", "wrong", "pairs", "mean, m", "mean, deg", "largest, m")


def draw(tasks: list[tuple[str, int, float]], done: list[Ending], canvas: Any) -> None:
    """Each drive as it lies at the end, put to the truth where it began."""
    grid = np.atleast_1d(canvas.subplots((len(done) + 1) // 2, min(2, len(done)), squeeze=False)).ravel()
    for axes, (name, seed, _), one in zip(grid, tasks, done, strict=False):
        T = se2.compose(one.truth[0], se2.inverse(one.pose[0]))
        lies = np.array([se2.compose(T, pose) for pose in one.pose])
        axes.plot(*one.truth[:, :2].T, "--", lw=1.6, color="tab:blue", label="true path")
        axes.plot(*lies[:, :2].T, "-", lw=0.8, color="tab:red", label="estimated path")
        axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
        axes.set_title(f"{name}, seed {seed}: {one.wrong} of {one.loops} loops wrong", fontsize=8)
    canvas.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
