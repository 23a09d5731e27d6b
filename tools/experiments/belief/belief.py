"""Belief in the place: never lost without a reason, never sure without one; every row with its limit.

``python -m tools.experiments --only belief [--rows clean,perturbed,...] [--trials N]``. Real logs are found through
LUMILOOP_DATA; rows on them are left out without it. Replays are kept in ``out/belief/<code>`` and not made again.
"""

from __future__ import annotations

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
        ValueError: there is no row of one of these names.
        Skipped: none of them can run here.
    """
    names = work.rows or (("clean",) if quick else tuple(ROWS))
    if unknown := set(names) - set(ROWS):
        raise ValueError(f"no such row: {', '.join(sorted(unknown))}; there are {', '.join(ROWS)}")
    parts: list[Report] = []
    notes: list[str] = []
    for name in names:
        try:
            parts.append(ROWS[name](work))
        except Skipped as reason:
            notes.append(f"row {name} is left out: {reason}")
    if not parts:
        raise Skipped("; ".join(notes))
    return Report(
        tuple(figure for part in parts for figure in part.figures),
        tuple(table for part in parts for table in part.tables),
        seeds=tuple(sorted({seed for part in parts for seed in part.seeds})),
        notes=(*(note for part in parts for note in part.notes), *notes),
    )
