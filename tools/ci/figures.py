"""Figures as data: every benchmark and experiment prints a table and leaves ``out/<name>.json``.

A figure says what was measured, in which unit, against which target, and with which command; ratios against a peer
name the peer and its version.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number.

    Attributes:
        target: human-readable bound (``<= 0.022``), empty where the number is only reported.
        ok: whether the bound was met; None where there is no bound or it could not be judged.
        command: what to type to measure it again.
    """

    name: str
    value: float
    unit: str
    target: str = ""
    ok: bool | None = None
    command: str = ""


def bounded(name: str, value: float, unit: str, target: str, command: str) -> Figure:
    """A figure judged against ``<= x`` or ``>= x``.

    Raises:
        ValueError: if the target is not of that form.
    """
    relation, _, bound = target.partition(" ")
    if relation not in ("<=", ">="):
        raise ValueError(f"figure {name!r}: target {target!r} must read '<= number' or '>= number'")
    limit = float(bound)
    value = float(value)  # numpy's scalars do not go into JSON
    ok = math.isfinite(value) and (value <= limit if relation == "<=" else value >= limit)
    return Figure(name, value, unit, target, ok, command)


def table(figures: Sequence[Figure]) -> str:
    """The figures as aligned text."""
    mark = {True: "ok", False: "MISSED", None: ""}
    rows = [("figure", "value", "unit", "target", "")]
    rows += [(f.name, f"{f.value:.4g}", f.unit, f.target, mark[f.ok]) for f in figures]
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)


def save(name: str, figures: Sequence[Figure], folder: Path = Path("out")) -> Path:
    """Write ``<folder>/<name>.json`` (a list of objects) and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    rows = [asdict(f) | {"value": float(f.value)} for f in figures]
    path.write_text(json.dumps(rows, indent=1) + "\n")
    return path
