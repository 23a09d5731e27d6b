"""Pages of results: one for each experiment that a folder holds, and ``README.md``, which says what there is."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

INDEX: Final = "README.md"
JUDGED: Final = {True: "ok", False: "**missed**", None: ""}

Facts = Mapping[str, Any]


def write(folder: Path, order: Sequence[str]) -> Path:
    """Write all pages of a folder anew from its JSON files; returns the index."""
    found = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    names = [name for name in order if name in found]
    for name in names:
        (folder / f"{name}.md").write_text(page(name, found[name]))
    (folder / INDEX).write_text(index({name: found[name] for name in names}))
    return folder / INDEX


def index(found: Mapping[str, Facts]) -> str:
    """What there is, and where each figure of the paper is."""
    rows = [
        (f"[{name}]({name}.md)", facts["paper"], facts["title"], met(facts), took(facts), facts["code"])
        for name, facts in found.items()
    ]
    parts = [
        "# Results",
        "Written by `python -m tools.experiments`, which makes all of them anew; nothing here is written by hand. Each "
        "page has tables, pictures, seeds, run time and the command for it alone. The code is a digest of the sources: "
        "where it differs from that of the tree, the result is of an earlier one, and the command makes it again.",
        markdown(("result", "of the paper", "what", "bounds met", "run time, s", "code"), rows),
    ]
    return "\n\n".join(parts) + "\n"


def page(name: str, facts: Facts) -> str:
    """One experiment."""
    seeds = ", ".join(map(str, facts["seeds"])) or "none: nothing is drawn by chance"
    parts = [
        f"# {name}" + (f": {facts['paper']}" if facts["paper"] else ""),
        facts["title"],
        f"`{facts['command']}`: {took(facts)} s, {facts['jobs']} processes; seeds {seeds}.",
    ]
    parts += [f"![{name}]({picture})" for picture in facts["pictures"]]
    for table in facts["tables"]:
        parts += [f"## {table['title']}", markdown(table["head"], table["rows"])]
    if facts["figures"]:
        rows = [(f["name"], f["value"], f["unit"], f["target"], JUDGED[f["ok"]]) for f in facts["figures"]]
        parts += ["## Figures", markdown(("figure", "value", "unit", "bound", ""), rows)]
    parts += [f"* {note}" for note in facts["notes"]]
    return "\n\n".join(parts) + "\n"


def met(facts: Facts) -> str:
    """How many bounds of those that there are."""
    judged = [figure["ok"] for figure in facts["figures"] if figure["ok"] is not None]
    return f"{sum(judged)} of {len(judged)}" if judged else "-"


def took(facts: Facts) -> str:
    """Run time; what is rough says so."""
    return f"{facts['seconds']:.0f}" + ", a quick part of it" * bool(facts["quick"])


def markdown(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table, numbers with four digits."""
    lines = [head, ["---"] * len(head), *([_cell(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(cell: object) -> str:
    if cell is None:
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell).replace("|", "\\|")
