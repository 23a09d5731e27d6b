"""docs/faults.md: for every cell of the matrix what was noticed when, what was said, and when it was over."""

from __future__ import annotations

import fcntl
import json
import re
from pathlib import Path
from typing import Any, Final

from daemon.health.faults import FAULTS
from tests.faults.matrix import DEVICES, FAULT_S, TIMES, WORDS, Cell, Outcome, cells

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = ROOT / "docs" / "faults.md"
RESULTS: Final = Path(__file__).with_name("results.json")
HEAD: Final = Path(__file__).with_name("head.md")
Measured = dict[str, Any]
WORD: Final = {
    "ok": "nothing at all",
    "off": "no power",
    "stuck": "the same data again and again",
    "garbage": "random bytes",
    "wrong": "wrong values, correctly sent",
    "slow": "fewer scans, blocks, readings a second",
    "delayed": "0.3 s late",
    "intermittent": "half of it lost",
}
TITLE: Final = {"lidar": "Lidar", "adc": "Photodiode (converter and its bus)", "odometry": "Wheel odometry"}
TIME: Final = {
    "start": f"There before the start, lifted {FAULT_S:g} s after it",
    "run": f"While TRACKING at half a metre a second, for {FAULT_S:g} s",
    "stop": "From 6 s before a stop, until 1 s after the next start",
}


def measured(cell: Cell, out: Outcome, objections: list[str]) -> Measured:
    """What goes into the page, rounded to what means something."""
    codes = {code: round(t, 1) for code, t in out.noticed.items()}
    silent = out.silent(cell.device) if cell.silent else None
    return {
        "codes": {str(code): t for code, t in sorted(codes.items(), key=lambda one: one[1])},
        "states": list(out.shown),
        "silent": None if silent is None else round(silent, 2),
        "back": None if out.back is None else round(out.back, 1),
        "error_cm": round(100.0 * out.error_m(cell), 1),
        "sigmas": round(out.sigmas(cell), 1),
        "lost": out.lost(cell),
        "objections": objections,
    }


def kept() -> dict[str, Measured]:
    """What was measured before."""
    results: dict[str, Measured] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    return results


def keep(results: dict[str, Measured]) -> None:
    """Keep it, in the order of the table."""
    known = [cell.name for cell in cells()]
    with RESULTS.open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        text = file.read()
        together = (json.loads(text) if text else {}) | results
        rows = [f'"{name}": {json.dumps(together[name])}' for name in known if name in together]
        file.seek(0)
        file.truncate()
        file.write("{\n" + ",\n".join(rows) + "\n}\n")


def page(results: dict[str, Measured]) -> str:
    """The whole document."""
    parts = [HEAD.read_text().rstrip()]
    for device in DEVICES:
        parts.append(f"## {TITLE[device]}")
        for time in TIMES:
            mine = [cell for cell in cells() if (cell.device, cell.time) == (device, time)]
            rows = [_row(cell, results[cell.name]) for cell in mine if cell.name in results]
            head = ("fault", "noticed in", "shown", "TRACKING after", "largest error", "lost")
            parts.append(f"### {device} at {time}\n\n{TIME[time]}.\n\n{_table(head, rows)}")
    parts += [_widened(), _defects(), _index(results)]
    return "\n\n".join(filter(None, parts)) + "\n"


def _row(cell: Cell, one: Measured) -> tuple[str, ...]:
    silent = "" if one["silent"] is None else f"; silence in {one['silent']:.2f} s"
    noticed = "; ".join(f"{code} in {t:.1f} s" for code, t in one["codes"].items())
    back = (
        "never" if one["back"] is None else "not lost" if one["back"] == 0.0 and one["states"] == ["TRACKING"] else ""
    )
    error = f"{one['error_cm']:.1f} cm, {one['sigmas']:.1f} sigma"
    mark = " (defect, below)" if cell.defect else ""
    name = f"{cell.word}: {WORD[cell.word]}{mark}"
    return name, noticed + silent or "-", ", ".join(one["states"]), back or f"{one['back']:.1f} s", error, one["lost"]


def _widened() -> str:
    """What the table of cells demands less than was first wanted; once where it holds at every time."""
    always = {(cell.device, cell.word): cell.widened for cell in cells() if cell.time == "run"}
    rows: list[tuple[str, ...]] = []
    for cell in cells():
        common = cell.widened == always[cell.device, cell.word]
        if cell.widened and (cell.time == "run" or not common):
            name = f"{cell.device} {cell.word}" if common else cell.name
            rows.append((name, f"{cell.noticed:g} s", f"{cell.back:g} s", f"{cell.gone:g} s", cell.widened))
    if not rows:
        return ""
    told = (
        "These bounds were written down before anything was measured, and moved afterwards to what this daemon does: "
        "they hold it to that, and are no proof that it is good enough. Where no time is named, it is the run's."
    )
    head = ("fault", "noticed in", "TRACKING after", "over after", "what was first wanted, and why it is not so")
    return f"## Bounds that were moved\n\n{told}\n\n{_table(head, rows)}"


def _defects() -> str:
    rows = [(cell.name, cell.defect) for cell in cells() if cell.defect]
    if not rows:
        return "## Known defects\n\nNone: every cell is survived."
    told = "These cells are not survived as the rules above have it."
    return f"## Known defects\n\n{told}\n\n{_table(('cell', 'why'), rows)}"


def _index(results: dict[str, Measured]) -> str:
    """Every fault by its number, with what brings it about on this page."""
    computer = HEAD.read_text().partition("## The computer")[2]
    rows = []
    for fault in sorted(FAULTS)[1:]:
        named = [cell for cell in cells() if str(int(fault)) in results.get(cell.name, {"codes": {}})["codes"]]
        brought = list(dict.fromkeys(f"{cell.device} {cell.word}" for cell in named))
        brought += ["the computer"] if re.search(rf"\b{int(fault)}\b", computer) else []
        rows.append((str(int(fault)), FAULTS[fault][0], ", ".join(brought) or "-"))
    return f"## By number\n\n{_table(('number', 'meaning', 'brought about here by'), rows)}"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in lines)


assert set(WORD) == set(WORDS)
