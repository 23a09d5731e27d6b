"""Belief in the place: never lost without a reason, never sure without one. Every row with its limit.

``--rows clean,perturbed`` makes only these, ``--trials N`` so many seeds of each. Real logs are found through
LUMILOOP_DATA. What has been made is kept in ``out/belief/<code>`` and not made again.
"""

from collections.abc import Callable
from typing import Final

from tools.experiments.belief import real_rows, sim_rows
from tools.experiments.support.report import Report, Skipped, Work

ROWS: Final[dict[str, Callable[[Work], Report]]] = {
    "clean": real_rows.clean,
    "perturbed": real_rows.perturbed,
    "spoiled": real_rows.spoiled,
    "wheels": real_rows.wheels,
    "mount": real_rows.mount,
    "lies": sim_rows.lies,
    "solutions": sim_rows.solutions,
    "reference": real_rows.reference,
    "speed": real_rows.speed,
}


def run(quick: bool, work: Work) -> Report:
    """All rows, or those of ``work.rows``; with ``quick`` the clean drives alone.

    Raises:
        Skipped: there is no row of one of these names, or none that can be made here.
    """
    parts = [Report(notes=("run time: without what the same code had made before, see `out/belief`",))]
    for name in work.rows or (("clean",) if quick else tuple(ROWS)):
        if name not in ROWS:
            raise Skipped(f"there is no row {name}; there are {', '.join(ROWS)}")
        try:
            parts.append(ROWS[name](work))
        except Skipped as reason:
            parts.append(Report(notes=(f"row {name} is left out: {reason}",)))
    if not any(part.figures for part in parts):
        raise Skipped("; ".join(note for part in parts for note in part.notes))
    figures, tables, notes = (
        [one for part in parts for one in getattr(part, what)] for what in ("figures", "tables", "notes")
    )
    seeds = sorted({seed for part in parts for seed in part.seeds})
    return Report(tuple(figures), tuple(tables), seeds=tuple(seeds), notes=tuple(notes))
