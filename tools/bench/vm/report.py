"""What came of a run: lines on the terminal, JUnit XML for machines, an HTML page for people, JSON to compare with."""

from __future__ import annotations

import html
import json
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

SLOWER: Final = 1.5
"""A scenario that takes this many times as long as in the run compared with is marked; the machine may be to blame."""


@dataclass(frozen=True, slots=True)
class Result:
    """Of one scenario: its name, title, whether it passed, seconds, and what was seen or what was wrong."""

    name: str
    title: str
    passed: bool
    seconds: float
    said: str


def junit(results: list[Result]) -> str:
    """The results as JUnit XML."""
    suite = ElementTree.Element(
        "testsuite", name="bench-vm", tests=str(len(results)), failures=str(sum(not one.passed for one in results)),
        time=f"{sum(one.seconds for one in results):.1f}",
    )  # fmt: skip
    for one in results:
        case = ElementTree.SubElement(suite, "testcase", classname="bench.vm", name=one.name, time=f"{one.seconds:.1f}")
        if one.passed:
            ElementTree.SubElement(case, "system-out").text = one.said
        else:
            ElementTree.SubElement(case, "failure", message=one.said.splitlines()[0][:200]).text = one.said
    return ElementTree.tostring(suite, encoding="unicode")


def regressions(results: list[Result], before: list[Result]) -> list[str]:
    """What has become worse since another run."""
    was = {one.name: one for one in before}
    found = []
    for one in results:
        old = was.get(one.name)
        if old is None:
            continue
        if old.passed and not one.passed:
            found.append(f"{one.name} passed then")
        elif one.passed and one.seconds > SLOWER * old.seconds + 2.0:
            found.append(f"{one.name} takes {one.seconds:.0f} s, {old.seconds:.0f} s then")
    return found


def page(results: list[Result], about: dict[str, str], worse: list[str]) -> str:
    """The results as one HTML page that needs nothing else."""
    rows = "".join(
        f"<tr class={'ok' if one.passed else 'bad'}><td>{'passed' if one.passed else 'FAILED'}<td>"
        f"{html.escape(one.title)}<td>{one.seconds:.1f}<td><pre>{html.escape(one.said)}</pre></tr>"
        for one in results
    )
    facts = "".join(f"<tr><td>{html.escape(key)}<td>{html.escape(value)}</tr>" for key, value in about.items())
    listed = "".join(f"<li>{html.escape(text)}" for text in worse)
    style = "body{font:15px sans-serif;margin:2em}td{padding:.2em .8em;vertical-align:top}.bad{background:#fcc}"
    style += "pre{white-space:pre-wrap;margin:0}tr{border-bottom:1px solid #ddd}table{border-collapse:collapse}"
    return (
        f"<!doctype html><meta charset=utf-8><title>lumiloop: virtual bench</title><style>{style}</style>"
        f"<h1>Virtual bench: {sum(one.passed for one in results)} of {len(results)} scenarios passed</h1>"
        f"<table>{facts}</table>{f'<h2>Worse than before</h2><ul>{listed}</ul>' if worse else ''}"
        f"<h2>Scenarios</h2><table><tr><th><th>what<th>s<th>seen</tr>{rows}</table>\n"
    )


def write(out: Path, results: list[Result], about: dict[str, str], against: Path | None) -> list[str]:
    """Write all three; returns what is worse than the run whose ``results.json`` ``against`` names."""
    out.mkdir(parents=True, exist_ok=True)
    before = [Result(**one) for one in json.loads(against.read_text())["results"]] if against is not None else []
    worse = regressions(results, before)
    about = {"computer": f"{platform.machine()}, {platform.release()}", **about}
    (out / "junit.xml").write_text(junit(results))
    (out / "report.html").write_text(page(results, about, worse))
    told = {"about": about, "results": [asdict(one) for one in results]}
    (out / "results.json").write_text(json.dumps(told, indent=1) + "\n")
    return worse
