"""The paper's third experiment (its Fig. 6): precision and recall of loop closures over drives that return.

Fifty-one drives of 80 m on random ways through the paper's symmetric room, from one start and back to it; people, slip
and lamps by chance. Two questions: *As driven*, which loops does the daemon close, that has an idea of its pose?
*Without an idea*: each of some keyframes is looked for in every earlier submap by branch and bound over the whole room
and every heading; there the laser alone takes the room's mirror images for the same place. Its curve is the baseline:
our own laser-only branch and bound (Cartographer's way of searching, not Cartographer itself).

Trials are kept as they are done, under a digest of the code: a run that was interrupted goes on where it was.
"""

from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from tools.ci.figures import Figure, bounded
from tools.experiments.paper_figures.fig6_curves import (
    SHARES,
    STEPS,
    THRESHOLDS_M,
    WORDS,
    Point,
    best,
    clear,
    counted,
    point,
    right,
    rule,
)
from tools.experiments.paper_figures.fig6_trial import COVERED, LASER, LIT, Drive, trial
from tools.experiments.paper_figures.fig6_truth import STRICT
from tools.experiments.support.report import COMMAND, Cell, Picture, Report, Table, Work, code

SEEDS: Final = tuple(range(1, 52))
KEPT: Final = Path("out/experiments")
SOURCES: Final = (
    "estimator/**/*.py",
    "tools/sim/**/*.py",
    "tools/experiments/fig6_tr*.py",
    "tools/experiments/support/loop_drives.py",
)
LENGTH_M: Final = 80.0
WAYS: Final = (LIT, LASER, COVERED)
LASER_STEPS: Final = 4
"""Conditions that the laser alone has."""
LIGHT_STEPS: Final = 5
"""Those that are the default with lights: all but the IDs."""


def run(quick: bool, work: Work) -> Report:
    """All drives; with ``quick`` one short one, which is not kept."""
    seeds, length = (SEEDS[:1], 40.0) if quick else (SEEDS, LENGTH_M)
    folder = None if quick else KEPT / f"fig6-{code(*SOURCES)}"
    drives = work.map(trial, [(seed, length) for seed in seeds], "fig6", folder)
    tables = (driven(drives), number_of_conditions(drives), thresholds(drives))
    picture = Picture("fig6", partial(draw, drives), (9.0, 4.2))
    return Report(tuple(figures(drives)), tables, (picture,), tuple(seeds), NOTES)


NOTES: Final = (
    "right: truly the same place, and the relative pose within 0.20 m and 1 deg; truth is the simulator's",
    "without an idea: with lights, a keyframe whose links are paused closes nothing; it counts for recall",
)


def of_way(drives: list[Drive], name: str) -> Point:
    """Loops that a robot closed as it drove."""
    total = np.zeros(4, int)
    for drive in drives:
        if name in drive.ways:
            total += counted(drive.ways[name].loops, drive.ways[name].asked)
    return Point(*total.tolist())


def driven(drives: list[Drive]) -> Table:
    """The daemon's loops."""
    rows: list[tuple[Cell, ...]] = []
    for name in WAYS:
        ways = [drive.ways[name] for drive in drives if name in drive.ways]
        if not ways:
            continue
        p, loops = of_way(drives, name), [one for way in ways for one in way.loops]
        strict = sum(right(one, STRICT) for one in loops) / max(1, len(loops))
        pose = sum(one.off_m <= 0.2 for one in loops) / max(1, len(loops))
        rmse, end, heading = ([getattr(way.errors, key) for way in ways] for key in ("rmse", "end", "heading"))
        found: list[Cell] = [p.accepted, 100.0 * p.precision, 100.0 * strict, 100.0 * pose, p.queries, 100.0 * p.recall]
        ended = 100.0 * float(np.median(rmse)), 100.0 * max(rmse), float(np.median(heading)), 100.0 * max(end)
        rows.append((name, len(ways), *found, *ended))
    return Table("As driven", DRIVEN, tuple(rows))


DRIVEN: Final = (
    "", "drives", "loops", "precision %", "strict %", "pose right %", "queries", "recall %", "ATE median, cm", "worst",
    "heading rms median, deg", "end worst, cm",
)  # fmt: skip


def number_of_conditions(drives: list[Drive]) -> Table:
    """Precision and recall as conditions are added."""
    rows: list[tuple[Cell, ...]] = []
    for steps in range(1, len(STEPS) + 1):
        name = ("" if steps == 1 else "+ ") + WORDS[STEPS[steps - 1]]
        cells: list[Cell] = [name]
        for lit in (False, True):
            p = point(drives, rule(steps, lit)) if lit or steps <= LASER_STEPS else None
            cells += ["-"] * 3 if p is None else [p.accepted, 100.0 * p.precision, 100.0 * p.recall]
        rows.append(tuple(cells))
    head = ("conditions", "laser: loops", "precision %", "recall %", "with lights: loops", "precision %", "recall %")
    return Table("Without an idea of the place, SSE threshold 6 cm", head, tuple(rows))


def curve(drives: list[Drive], steps: int, lit: bool) -> list[Point]:
    """Over SSE thresholds."""
    return [point(drives, rule(steps, lit, sse_m)) for sse_m in THRESHOLDS_M]


def shares(drives: list[Drive], steps: int, lit: bool) -> list[Point]:
    """Over least shares of beams that fit."""
    return [point(drives, rule(steps, lit, share=share)) for share in SHARES]


def thresholds(drives: list[Drive]) -> Table:
    """What the best points of the curves are."""
    rows: list[tuple[Cell, ...]] = []
    for name, steps, lit in (("laser alone", LASER_STEPS, False), ("with lights", LIGHT_STEPS, True)):
        for swept, points in (("SSE", curve(drives, steps, lit)), ("overlap", shares(drives, steps, lit))):
            found = [100.0 * best(points, least) for least in (1.0, 0.995, 0.99)]
            rows.append((f"{name}, {swept} swept", *found, 100.0 * max(p.f1 for p in points)))
    head = ("without an idea", "recall % at precision 100 %", "at 99.5 %", "at 99 %", "largest F1 %")
    return Table("Thresholds", head, tuple(rows))


def figures(drives: list[Drive]) -> list[Figure]:
    """What is bounded."""
    command = f"{COMMAND} fig6"
    lit, laser = of_way(drives, LIT), of_way(drives, LASER)
    free = [*curve(drives, LIGHT_STEPS, True), *shares(drives, LIGHT_STEPS, True)]
    told = [clear(drive) for drive in drives]
    seen = [*curve(told, LIGHT_STEPS, True), *shares(told, LIGHT_STEPS, True)]
    worst = max(drive.ways[LIT].errors.rmse for drive in drives)
    median = float(np.median([drive.ways[LIT].errors.rmse for drive in drives]))
    heading = float(np.median([drive.ways[LIT].errors.heading for drive in drives]))
    out = [
        bounded("loops as driven, with lights: precision", 100.0 * lit.precision, "%", ">= 99.5", command),
        bounded("loops as driven, with lights: recall", 100.0 * lit.recall, "%", ">= 90", command),
        Figure("loops as driven, laser alone: precision", 100.0 * laser.precision, "%", command=command),
        Figure("loops as driven, laser alone: recall", 100.0 * laser.recall, "%", command=command),
        Figure("no idea, with lights: recall at 99 % precision", 100.0 * best(free, 0.99), "%", command=command),
        Figure("the same where enough links are clear", 100.0 * best(seen, 0.99), "%", command=command),
        bounded(f"{LENGTH_M:g} m with lights: trajectory RMSE, median", 100.0 * median, "cm", "<= 3", command),
        Figure(f"{LENGTH_M:g} m with lights: trajectory RMSE, worst", 100.0 * worst, "cm", command=command),
        bounded(f"{LENGTH_M:g} m with lights: heading RMS, median", heading, "deg", "<= 0.3", command),
    ]
    both = [drive for drive in drives if COVERED in drive.ways]
    if both:
        a, b = of_way(both, COVERED), of_way(both, LASER)
        apart = 100.0 * max(abs(a.precision - b.precision), abs(a.recall - b.recall))
        out.append(bounded("lamps covered against laser alone", apart, "%", "<= 1", command))
    return out


def draw(drives: list[Drive], canvas: Any) -> None:
    """Precision over recall."""
    axes = canvas.subplots(1, 2, sharey=True)
    shades = ("#9ecae1", "#6baed6", "#3182bd", "#08519c", "#31a354", "#006d2c")
    for steps in range(1, len(STEPS) + 1):
        words = f"{steps}: " + ("" if steps == 1 else "+ ") + WORDS[STEPS[steps - 1]]
        points = curve(drives, steps, True)
        axes[0].plot(*xy(points), "o-", ms=3, lw=1.0, color=shades[steps - 1], label=words)
    points = curve(drives, LASER_STEPS, False)
    axes[0].plot(*xy(points), "s--", ms=3, lw=1.0, color="tab:red", label="laser alone, conditions 1 to 4")
    axes[0].set_title("no prior pose: threshold of SSE varies", fontsize=9)
    for lit, steps, how, name in (
        (True, LIGHT_STEPS, "o-", "with lights"),
        (False, LASER_STEPS, "s--", "laser alone (branch and bound)"),
    ):
        axes[1].plot(*xy(shares(drives, steps, lit)), how, ms=3, lw=1.0, label=f"no prior pose, {name}")
    for name, mark in ((LIT, "*"), (LASER, "x")):
        p = of_way(drives, name)
        axes[1].plot([p.recall], [p.precision], mark, ms=9, label=f"as driven, {name}")
    axes[1].set_title("threshold of the share of beams that fit varies; as driven", fontsize=9)
    for one in axes:
        one.set(xlabel="recall (1 = all)", xlim=(0.0, 1.02))
        one.grid(alpha=0.3)
        one.legend(fontsize=6, loc="lower left")
    axes[0].set(ylabel="precision (1 = no wrong loop)", ylim=(0.0, 1.02))


def xy(points: list[Point]) -> tuple[list[float], list[float]]:
    """Recall and precision of those that accept anything."""
    some = [one for one in points if one.accepted]
    return [one.recall for one in some], [one.precision for one in some]
