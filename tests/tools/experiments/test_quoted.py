"""Numbers that the pages quote are those of the results."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[3] / "docs"
PAGES = "\n".join(
    page.read_text()
    for page in sorted(DOCS.rglob("*.md"))
    if page.parent.name != "results" or page.name.startswith("measured-")
)


def tables(name: str) -> dict[str, Any]:
    """Rows of a result's tables by title and first cell."""
    found = json.loads((DOCS / "results" / f"{name}.json").read_text())
    return {table["title"]: {row[0]: row[1:] for row in table["rows"]} for table in found["tables"]}


def quoted(first: str) -> list[str]:
    """Cells of the row of the pages that begins so, without marks."""
    (row,) = re.findall(rf"^\| {re.escape(first)} \|(.*)\|$", PAGES, re.MULTILINE)
    return [cell.strip().replace("**", "") for cell in row.split("|")]


@pytest.mark.parametrize("campaign", ["RSS", "RSS_0923"])
@pytest.mark.parametrize("solver", ["ls", "lin", "ml"])
def test_recorded_strengths(campaign: str, solver: str) -> None:
    rows = tables("fig4")[f"recorded, {campaign}: position error, cm, split half"]
    pairs = zip(rows[f"{solver}, median"], rows[f"{solver}, 90th percentile"], strict=True)
    assert quoted(f"{campaign}: `{solver}`") == [f"{median:.1f} ({most:.1f})" for median, most in pairs]
    if solver == "ls":
        assert rows["ls, median"][0] == min(rows["ls, median"]), "the page says that three links are best"


def test_recorded_walks() -> None:
    ((_, walks),) = tables("walks").items()
    mean, most = walks["circle_inclined10"][2], walks["square_blocked"][4]
    bare, level = walks["circle_inclined10, lean not used"][2], walks["circle_level, two-fold"][2]
    assert quoted("receiver inclined by 10 deg, mean")[0] == f"{mean:.1f} cm ({bare:.1f} cm without the lean)"
    assert quoted("LEDs covered now and then, 90th percentile")[0] == f"{most:.1f} cm"
    assert quoted("level, each half by the other, mean")[0] == f"{level:.1f} cm"


def test_light_as_driven_does_not_raise_recall() -> None:
    driven = tables("fig6")["As driven"]
    lit, laser = driven["laser and lights"][6], driven["laser alone"][6]
    assert lit < laser
    for words in ("Light as driven does not raise recall**: {} with lights, {} by the laser alone",):
        assert words.format(f"{lit:.1f} %", f"{laser:.1f} %") in PAGES
