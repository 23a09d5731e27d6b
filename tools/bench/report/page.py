"""What came of a run on a bench: JUnit XML for machines, an HTML page for people, JSON to compare the next run with.

One report for all of them: the virtual bench, the suite on devices (tests/hil), and the bench computer that plays the
world (tools/bench/world).
"""

import contextlib
import html
import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

from daemon.config.paths import can_be_made
from daemon.system.versions import versions
from tools.bench.report.against import Before, Compared, Old, compare
from tools.bench.report.plots import svg
from tools.bench.report.result import About, Result

ROOT: Final = Path(__file__).parents[3]
FILES: Final = ("junit.xml", "report.html", "results.json")
SLOWER: Final = 1.5
"""What takes this many times as long as in the run compared with is marked in the page, and no worse for it: a figure
tells of what is tested, seconds tell of the machine around it, too."""


class CannotReport(Exception):
    """Nothing can be written where the report is to go; the text says so."""


def facts(**more: str) -> dict[str, str]:
    """Which software, on which computer, how busy; and ``more``."""
    return {
        "version": _described() or versions()["lumiloop"],
        "software": ", ".join(f"{name} {number}" for name, number in versions().items()),
        "computer": f"{platform.machine()}, {platform.release()}, {os.cpu_count()} processors",
        "load": f"{os.getloadavg()[1]:.1f}",
        **more,
    }


def _described() -> str:
    """Of a git tree, its commit; empty where it is none, or git is not there."""
    words = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    with contextlib.suppress(OSError):
        return subprocess.run(words, capture_output=True, text=True).stdout.strip()
    return ""


def junit(results: list[Result], name: str = "bench", worse: Mapping[str, list[str]] | None = None) -> str:
    """The results as JUnit XML. ``worse``: than in another run, by the result's name; it is a failure, too."""
    lost = worse or {}
    failed = sum(one.outcome == "FAILED" or one.name in lost for one in results)
    skipped = sum(bool(one.skipped) and one.name not in lost for one in results)
    suite = ElementTree.Element(
        "testsuite", name=name, tests=str(len(results)), failures=str(failed), skipped=str(skipped),
        time=f"{sum(one.seconds for one in results):.1f}",
    )  # fmt: skip
    for one in results:
        where = name.replace("-", ".")
        case = ElementTree.SubElement(suite, "testcase", classname=where, name=one.name, time=f"{one.seconds:.1f}")
        if one.figures or one.fake:
            kept = ElementTree.SubElement(case, "properties")
            if one.fake:
                ElementTree.SubElement(kept, "property", name="device", value="fake")
            for figure in one.figures:
                ElementTree.SubElement(kept, "property", name=figure.name, value=f"{figure.value:.9g} {figure.unit}")
        _outcome(case, one, lost.get(one.name, []))
    return ElementTree.tostring(suite, encoding="unicode")


def _outcome(case: ElementTree.Element, one: Result, lost: list[str]) -> None:
    """Below a test case, what came of it."""
    if one.outcome == "FAILED" or lost:
        told = "\n".join([*filter(None, [one.said]), *(f"worse than before: {text}" for text in lost)])
        first = (told.splitlines() or [""])[0] if one.outcome == "FAILED" else f"worse than before: {lost[0]}"
        ElementTree.SubElement(case, "failure", message=_plain(first[:200])).text = _plain(told)
    elif one.skipped:
        ElementTree.SubElement(case, "skipped", message=_plain(one.skipped))
    else:
        ElementTree.SubElement(case, "system-out").text = _plain(one.said)


def _plain(text: str) -> str:
    """Without what XML cannot hold: a device's garbage may stand in a message."""
    return "".join(char if char in "\t\n" or char.isprintable() else "?" for char in text)


STYLE: Final = (
    "body{font:15px sans-serif;margin:2em}td{padding:.2em .8em;vertical-align:top}.FAILED{background:#fcc}"
    ".skipped{color:#777}pre{white-space:pre-wrap;margin:0;max-width:80em}tr{border-bottom:1px solid #ddd}"
    "table{border-collapse:collapse}svg{margin:.3em}"
)


def page(results: list[Result], about: About, compared: Compared, before: Before | None = None) -> str:
    """The results as one HTML page that needs nothing else."""
    rows = "".join(_row(one, before.results.get(one.name) if before else None) for one in results)
    told = "".join(f"<tr><td>{html.escape(k)}<td><pre>{html.escape(v)}</pre></tr>" for k, v in about.facts.items())
    pictures = "".join(
        f"<h3>{html.escape(one.title)}</h3>{''.join(map(svg, one.plots))}" for one in results if one.plots
    )
    return (
        f"<!doctype html><meta charset=utf-8><title>lumiloop: {html.escape(about.title)}</title><style>{STYLE}</style>"
        f"<h1>{html.escape(about.title)}: {counted(results)}</h1><table>{told}</table>"
        f"{_listed('Worse than before', compared.worse)}{_listed('Compared', compared.told)}"
        f"<h2>Results</h2><table><tr><th><th>what<th>s<th>seen</tr>{rows}</table>"
        f"{f'<h2>Pictures</h2>{pictures}' if pictures else ''}\n"
    )


def counted(results: list[Result]) -> str:
    """How many passed, of them on fakes, and how many were not tried."""
    fakes = sum(one.outcome == "passed" and one.fake for one in results)
    skipped = sum(bool(one.skipped) for one in results)
    text = f"{sum(one.outcome == 'passed' for one in results)} of {len(results)} passed"
    return f"{text}{f' ({fakes} of them on fakes)' if fakes else ''}{f', {skipped} not tried' if skipped else ''}"


def _listed(title: str, lines: Sequence[str]) -> str:
    rows = "".join(f"<li>{html.escape(text)}" for text in lines)
    return f"<h2>{title}</h2><ul>{rows}</ul>" if rows else ""


def _row(one: Result, old: Old | None) -> str:
    was = old.figures if old else {}
    lines = [f"{figure}{f' ({was[figure.name]:.4g} then)' if figure.name in was else ''}" for figure in one.figures]
    text = html.escape("\n".join([one.skipped or one.said, *lines]))
    slow = f" ({old.seconds:.1f} then)" if old and one.seconds > SLOWER * old.seconds + 2.0 else ""
    told = f"{one.outcome} (fake)" if one.fake else one.outcome
    return (
        f"<tr class={one.outcome}><td>{told}<td>{html.escape(one.title)}<td>{one.seconds:.1f}{slow}"
        f"<td><pre>{text}</pre></tr>"
    )


def demand_room(out: Path, option: str = "--out") -> None:
    """Before anything is tried: raise `CannotReport` where this user cannot write a report into ``out``."""
    kept = [out / name for name in FILES if (out / name).exists()]
    if not can_be_made(out) or not all(os.access(file, os.W_OK) for file in kept):
        raise CannotReport(f"nothing can be written to {out}; name another folder with {option}")


def demand_apart(out: Path, before: Before | None, option: str = "--out") -> None:
    """Before anything is tried: raise `CannotReport` where the report would overwrite the one to compare with."""
    if before is not None and before.file.resolve() in [(out / name).resolve() for name in FILES]:
        raise CannotReport(
            f"{before.file} is to be compared with, and this run's report would overwrite it; name another folder with "
            f"{option}"
        )


def write(out: Path, results: list[Result], about: About, before: Before | None = None) -> Compared:
    """Write all three into ``out``; returns how it compares with the run ``before``."""
    out.mkdir(parents=True, exist_ok=True)
    compared = compare(results, about.facts, before)
    told = {"bench": about.name, "about": about.facts, "results": [_kept(one) for one in results]}
    texts = (
        junit(results, about.name, compared.of),
        page(results, about, compared, before),
        json.dumps(told, indent=1) + "\n",
    )
    for name, text in zip(FILES, texts, strict=True):
        (out / name).write_text(text, encoding="utf-8")
    return compared


def _kept(one: Result) -> dict[str, Any]:
    """What a later run is compared with: no pictures."""
    return {key: value for key, value in asdict(one).items() if key != "plots"}
