"""Rows in the simulator: sensors that lie, the full solution against its subsets, and honest covariances."""

from __future__ import annotations

import importlib
import logging
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from tools.experiments.belief.lies import GYRO, LIES, Case, Told, followed, told
from tools.experiments.belief.real_rows import figure
from tools.experiments.belief.replays import kept
from tools.experiments.integrity.run import COLUMNS
from tools.experiments.integrity.scene import SECONDS, Scenario, draw
from tools.experiments.support.report import Report, Skipped, Table, Work
from tools.sim.building.world import Array

LIE_SEEDS, DRIVES = 3, 6
NAMED_S: Final = 10.0
SETTLED_S: Final = 15.0
"""From here on a solution counts."""
CLASSES: Final = ("clean_lit", "crowd_lit", "glass_lit", "clean_unlit", "crowd_unlit", "glass_unlit")
INSIDE: Final = 7.815
"""Squared Mahalanobis distance of three dimensions that 95 % are below."""
OTHERS: Final = {"fusion": "tools.experiments.fusion", "second_world": "tools.experiments.second_world"}
"""Experiments whose tables belong to the row of solutions, where they are."""
_AT: Final = {name: number for number, name in enumerate(COLUMNS)}


def lies(work: Work) -> Report:
    """Sensors that lie while the others are right."""
    seeds = range(1, 1 + (work.trials or LIE_SEEDS))
    cases = [Case(name, lit, seed) for name, lie in LIES.items() for lit in lie.lit for seed in seeds]
    found = [one for one in work.map(told, cases, "lies", kept()) if one is not None]
    table = []
    for name, lie in LIES.items():
        for lit in lie.lit:
            some = [one for one in found if (one.case.lie, one.case.lit) == (name, lit)]
            if some:
                table.append(_lie(name, lit, some))
    third = [one for one in found if _third(one)]
    beyond, cycles = sum(one.found.beyond_bound for one in found), sum(one.found.bounded for one in found)
    late = sum(one.named > NAMED_S for one in third)
    head = ("lie", "drives", "TRACKING and wrong, worst, s", "drives in which too long", "worst, m", "worst, deg",
            "named after, worst, s", "named instead", "cycles beyond the bound", "of cycles",
            "TRACKING, %")  # fmt: skip
    return Report(
        (
            figure("lies", f"lies: TRACKING and wrong, of {len(found)}", sum(one.lied for one in found), "", "<= 0"),
            figure("lies", f"lies with a third witness: not named within 10 s, of {len(third)}", late, "", "<= 0"),
            figure("lies", "lies: cycles beyond the bound, share", beyond / max(1, cycles), "", "<= 1e-4"),
        ),
        (Table("Sensors that lie", head, tuple(table)),),
        seeds=tuple(seeds),
        notes=("wrong: TRACKING beyond 0.5 m or 5 deg for longer than 0.5 s (lit) or 2 s (unlit); a fault counts as "
               "named from when it is present, and a third witness is lamps, or laser and wheels for a gyro",),
    )  # fmt: skip


def _third(one: Told) -> bool:
    return one.case.lit or LIES[one.case.lie].culprits == GYRO


def _lie(name: str, lit: bool, some: list[Told]) -> tuple[str | float | int, ...]:
    named = max(one.named for one in some)
    unnamed = sum(math.isinf(one.named) for one in some)
    instead = sorted({one.other for one in some} - {0})
    found = [one.found for one in some]
    return (
        f"{name}, {'lit' if lit else 'unlit'}", len(some),
        max(one.wrong_s for one in found), sum(one.lied for one in some),
        max(one.worst_m for one in found), max(one.worst_deg for one in found),
        named if math.isfinite(named) else f"never in {unnamed}", " ".join(map(str, instead)),
        sum(one.beyond_bound for one in found), sum(one.bounded for one in found),
        100.0 * float(np.mean([one.tracking for one in found])),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Solved:
    """A drive of a class, solved with the sensors of ``use``: all, laser, light."""

    kind: str
    seed: int
    use: str


def solved(case: Solved) -> Array | None:
    """(cycles, columns) track; None where nothing can drive in the room that was drawn."""
    logging.disable(logging.CRITICAL)
    try:
        scene = draw(case.kind, case.seed)
    except RuntimeError:
        return None
    scene.wheels = True
    _left(scene, case.use)
    return followed(scene)[1]


def _left(scene: Scenario, use: str) -> None:
    """Leave a scenario some of its sensors."""
    if use == "laser":
        scene.lit, scene.ceilings, scene.told = False, (), None
    elif use == "light":
        scene.blind = ((0.0, SECONDS),)


def solutions(work: Work) -> Report:
    """The full solution against wheels with laser or light alone, and how honest the covariances are."""
    drives = range(work.trials or DRIVES)
    cases = [
        Solved(kind, seed, use)
        for kind in CLASSES
        for seed in drives
        for use in (("all", "laser", "light") if kind.endswith("_lit") else ("all",))
    ]
    tracks = dict(zip(cases, work.map(solved, cases, "solutions", kept()), strict=True))
    against, nees = [], []
    for kind in CLASSES:
        whole = [
            track for case, track in tracks.items() if (case.kind, case.use) == (kind, "all") and track is not None
        ]
        nees.append((kind, len(whole), *honest(whole)))
        if kind.endswith("_lit"):
            rms = {use: _rms([tracks[Solved(kind, seed, use)] for seed in drives]) for use in ("all", "laser", "light")}
            better = [min(rms["laser"][axis], rms["light"][axis]) for axis in (0, 1)]
            against.append((kind, *(v for use in rms for v in rms[use]), *(rms["all"][a] / better[a] for a in (0, 1))))
    figures = [
        figure(
            "solutions",
            f"full over the better subset, {name}, worst class",
            max(row[k] for row in against),
            "",
            "<= 1.05",
        )
        for name, k in (("position", 7), ("heading", 8))
    ]
    figures += [
        figure("solutions", "NEES of the 3-dof pose, largest class", max(row[2] for row in nees), "", "<= 4"),
        figure("solutions", "NEES of the 3-dof pose, smallest class", min(row[2] for row in nees), "", ">= 2"),
        figure("solutions", "inside the 95 % ellipse, worst class", min(row[3] for row in nees), "%", ">= 93"),
    ]
    sides = ("full", "laser", "light")
    head = ("class", *(f"{side}, {unit}" for side in sides for unit in ("cm", "deg")), "ratio, cm", "ratio, deg")
    tables = [
        Table("Full against its subset solutions, rms", head, tuple(against)),
        Table(
            "Normalised error of the published pose", ("class", "drives", "NEES, mean", "inside 95 %, %"), tuple(nees)
        ),
    ]
    notes = [f"each subset is a run of its own: the lamps, or the lidar, are left out; from {SETTLED_S:.0f} s on"]
    for name, module in OTHERS.items():
        part = of_others(module, work)
        if part is None:
            notes.append(f"experiment `{name}` is not there")
            continue
        figures += part.figures
        tables += part.tables
        notes += part.notes
    return Report(tuple(figures), tuple(tables), seeds=tuple(drives), notes=tuple(notes))


def of_others(module: str, work: Work) -> Report | None:
    """What another experiment finds; None where it is not there, or cannot run here."""
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError:
        return None
    try:
        report = found.run(False, work)
    except Skipped:
        return None
    assert isinstance(report, Report)
    return report


def honest(tracks: list[Array]) -> tuple[float, float]:
    """Mean over the drives of the NEES, and share (%) of the cycles inside the 95 % ellipse."""
    late = [track[track[:, _AT["t"]] > SETTLED_S] for track in tracks]
    known = [(track[track[:, _AT["sigma_m"]] < 10.0][:, _AT["deviations"]]) ** 2 for track in late]
    known = [squared for squared in known if len(squared)]
    if not known:
        return math.nan, math.nan
    return float(np.mean([np.mean(one) for one in known])), 100.0 * float(np.mean(np.concatenate(known) < INSIDE))


def _rms(tracks: list[Array | None]) -> tuple[float, float]:
    """Of position in cm and heading in deg, over all drives."""
    whole = np.concatenate(
        [track[track[:, _AT["t"]] > SETTLED_S] for track in tracks if track is not None and len(track)]
    )
    m, rad = (math.sqrt(float(np.mean(whole[:, _AT[name]] ** 2))) for name in ("error_m", "error_rad"))
    return 100.0 * m, math.degrees(rad)
