"""Rows in the simulator: sensors that lie, the full solution against light alone, and honest covariances."""

import importlib
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from tools.experiments import __main__ as program
from tools.experiments.belief.lies import GYRO, LIES, Case, Outcome, outcome
from tools.experiments.belief.real_rows import figure
from tools.experiments.belief.replays import kept
from tools.experiments.integrity.run import COLUMNS
from tools.experiments.support.report import Report, Table, Work
from tools.sim.building.world import Array

LIE_SEEDS, DRIVES = 3, 6
NAMED_S, SETTLED_S = 10.0, 15.0
"""Time until the culprit is named; and from the start until a solution counts."""
CLASSES: Final = tuple(f"{what}_{light}" for light in ("lit", "unlit") for what in ("clean", "crowd", "glass"))
INSIDE: Final = 7.815
"""Squared Mahalanobis distance of three dimensions that 95 % are below."""
OTHERS: Final = ("fusion", "second-world")
"""Experiments whose tables belong to the row of solutions."""


def _outcomes(work: Work, cases: list[Case]) -> dict[Case, Outcome]:
    made = zip(cases, work.map(outcome, cases, "drives in the simulator", kept()), strict=True)
    return {case: one for case, one in made if one is not None}


def lies(work: Work) -> Report:
    """Sensors that lie while the others are right."""
    seeds = range(1, 1 + (work.trials or LIE_SEEDS))
    groups = {
        f"{name}, {'lit' if lit else 'unlit'}": [Case(name, "clean_lit" if lit else "clean_unlit", k) for k in seeds]
        for name, lie in LIES.items()
        for lit in lie.lit
    }
    every = _outcomes(work, [case for cases in groups.values() for case in cases])
    table = [(name, *_summed(some)) for name, of in groups.items() if (some := [every[c] for c in of if c in every])]
    third = [one for one in every.values() if one.case.lit or LIES[one.case.lie].culprits == GYRO]
    beyond, cycles = (sum(getattr(one.found, name) for one in every.values()) for name in ("beyond_bound", "bounded"))
    head = ("lie", "drives", "TRACKING and wrong, longest, s", "drives in which too long", "worst, m", "worst, deg",
            "named after, worst, s", "named instead", "cycles beyond the bound", "of cycles")  # fmt: skip
    figures = (
        figure("lies", f"lies: TRACKING and wrong, of {len(every)}", sum(row[3] for row in table), "", "<= 0"),
        figure("lies", f"lies with a third witness: not named within 10 s, of {len(third)}",
               sum(one.named > NAMED_S for one in third), "", "<= 0"),
        figure("lies", "lies: share of the cycles beyond the bound", beyond / max(1, cycles), "", "<= 1e-4"),
    )  # fmt: skip
    note = (
        "wrong: TRACKING beyond 0.5 m or 5 deg for longer than 0.5 s (lit) or 2 s (unlit); the third witness is light, "
        "or for a gyro the wheels; errors are those while TRACKING"
    )
    return Report(figures, (Table("Sensors that lie", head, tuple(table)),), seeds=tuple(seeds), notes=(note,))


def _summed(some: list[Outcome]) -> tuple[int, float, int, float, float, float | str, str, int, int]:
    found, named = [one.found for one in some], max(one.named for one in some)
    return (
        len(some), max(one.wrong_s for one in found), sum(one.wrong for one in found),
        max(one.worst_m for one in found), max(one.worst_deg for one in found),
        named if math.isfinite(named) else f"never in {sum(math.isinf(one.named) for one in some)}",
        " ".join(str(fault) for fault in sorted({one.other for one in some} - {0})),
        sum(one.beyond_bound for one in found), sum(one.bounded for one in found),
    )  # fmt: skip


def solutions(work: Work) -> Report:
    """The full solution against light and wheels, and how honest the covariances are."""
    seeds = range(work.trials or DRIVES)
    lit = [kind for kind in CLASSES if not kind.endswith("_unlit")]
    cases = [Case("", kind, k) for kind in CLASSES for k in seeds] + [
        Case("", kind, k, "light") for kind in lit for k in seeds
    ]
    every = _outcomes(work, cases)

    def of(kind: str, use: str) -> list[Array]:
        return [one.rows for case, one in every.items() if (case.kind, case.use) == (kind, use) and len(one.rows)]

    against: list[tuple[str, float, float, float, float, float, float]] = []
    for kind in lit:
        full, light = _rms(of(kind, "both")), _rms(of(kind, "light"))
        against.append((kind, *full, *light, full[0] / light[0], full[1] / light[1]))
    nees = [(kind, *honest(of(kind, "both"))) for kind in CLASSES]
    figures = [
        figure(
            "solutions",
            "full over light alone, rms of position, worst class",
            max(row[5] for row in against),
            "",
            "<= 1.05",
        ),
        figure(
            "solutions",
            "full over light alone, rms of heading, worst class",
            max(row[6] for row in against),
            "",
            "<= 1.05",
        ),
        figure("solutions", "NEES of the 3-dof pose, largest class", max(row[1] for row in nees), "", "<= 4"),
        figure("solutions", "NEES of the 3-dof pose, smallest class", min(row[1] for row in nees), "", ">= 2"),
        figure("solutions", "inside the 95 % ellipse, worst class", min(row[2] for row in nees), "%", ">= 93"),
    ]
    head = ("class", "full, cm", "full, deg", "light, cm", "light, deg", "ratio, cm", "ratio, deg")
    tables = [
        Table("Full against light and wheels, rms", head, tuple(against)),
        Table("Normalised error of the published pose", ("class", "NEES, mean", "inside 95 %, %"), tuple(nees)),
    ]
    notes = [f"light alone is a run of its own, with the lidar covered; from {SETTLED_S:.0f} s on. The laser alone has "
             "another frame: experiment `fusion` compares it"]  # fmt: skip
    for name in (name for name in OTHERS if name in program.MODULES):
        part: Report = importlib.import_module(program.MODULES[name]).run(False, work)
        figures += part.figures
        tables += part.tables
        notes += part.notes
    return Report(tuple(figures), tuple(tables), seeds=tuple(seeds), notes=tuple(notes))


def honest(tracks: Sequence[Array]) -> tuple[float, float]:
    """Mean over the drives of the NEES, and share (%) of the cycles inside the 95 % ellipse."""
    late = [track[track[:, 0] > SETTLED_S] for track in tracks]
    known = [track[track[:, COLUMNS.index("sigma_m")] < 10.0, COLUMNS.index("deviations")] ** 2 for track in late]
    known = [squared for squared in known if len(squared)]
    if not known:
        return math.nan, math.nan
    return float(np.mean([np.mean(one) for one in known])), 100.0 * float(np.mean(np.concatenate(known) < INSIDE))


def _rms(tracks: Sequence[Array]) -> tuple[float, float]:
    """Of position in cm and heading in deg, over all drives."""
    whole = np.concatenate([track[track[:, 0] > SETTLED_S] for track in tracks])
    m, rad = (math.sqrt(np.mean(whole[:, COLUMNS.index(name)] ** 2)) for name in ("error_m", "error_rad"))
    return 100.0 * m, math.degrees(rad)
