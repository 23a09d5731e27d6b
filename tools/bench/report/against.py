"""A run of a bench against another one of the same bench: what has become worse, and what could be compared at all."""

import hashlib
import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec

from tools.bench.report.result import Result

NAMED: Final = 6
"""So many names of what cannot be compared are told."""
ENDS: Final = ("computer", "robot", "lidar", "adc", "light", "odometry", "have", "walk-s", "configuration")
"""Facts that say what was measured: where they differ, a figure may differ for that reason."""
SKIPPED: Final = "skipped"
SCENARIO: Final = "scenario "
"""So begin, before a scenario's name, the facts that say by its digest what was played."""


class CannotCompare(Exception):
    """The run to compare with cannot be; the text says why."""


class OldFigure(msgspec.Struct):
    """Of a report's file, what is needed here; so are the next two."""

    name: str
    value: float
    worse: str = ""


class Old(msgspec.Struct):
    """What another run says of the same thing."""

    name: str
    passed: bool
    seconds: float
    skipped: str = ""
    measured: list[OldFigure] = msgspec.field(name="figures", default_factory=list)

    @property
    def outcome(self) -> str:
        """In a word."""
        return SKIPPED if self.skipped else "passed" if self.passed else "FAILED"

    @property
    def figures(self) -> dict[str, float]:
        """Values by name."""
        return {figure.name: figure.value for figure in self.measured}


class _Kept(msgspec.Struct):
    results: list[Old]
    bench: str = ""
    about: dict[str, str] = {}


@dataclass(frozen=True, slots=True)
class Before:
    """Another run. ``bench``: whose report it is, empty in reports of versions that did not say it."""

    file: Path
    bench: str
    facts: dict[str, str]
    results: dict[str, Old]

    def demand(self, names: Collection[str]) -> None:
        """Raise `CannotCompare` where nothing was tried of that by which this run's results will be called."""
        shared = sorted(set(names) & set(self.results))
        if names and not shared:
            raise CannotCompare(
                f"{self.file} has nothing of what is to be tried now ({_some(sorted(names))}); it has "
                f"{_some(sorted(self.results)) or 'no results'}"
            )
        if shared and all(self.results[name].outcome == SKIPPED for name in shared):
            raise CannotCompare(
                f"{self.file} has nothing of what is to be tried now: {_some(shared)} was skipped then; name a run "
                "that has tried it"
            )


@dataclass(frozen=True, slots=True)
class Compared:
    """What came of it: lines that say what could be compared, and by the result's name what of it has become worse.

    Both are empty without another.
    """

    told: tuple[str, ...] = ()
    of: dict[str, list[str]] = field(default_factory=dict)

    @property
    def worse(self) -> list[str]:
        """All that has become worse."""
        return [text for lines in self.of.values() for text in lines]

    def closing(self) -> list[str]:
        """The last lines of a bench: nothing that reads like success may follow what makes it fail."""
        lines = [*self.told, *(f"worse than before: {text}" for text in self.worse)]
        return [*lines, f"FAILED: {len(self.worse)} worse than before"] if self.worse else lines


def read(against: Path, bench: str) -> Before:
    """Another run of ``bench``; ``against`` is its ``results.json`` or the folder that holds it.

    Raises:
        CannotCompare: there is none, it is something else, or another bench's.
    """
    file = against / "results.json" if against.is_dir() else against
    try:
        told = msgspec.convert(json.loads(file.read_text(encoding="utf-8")), _Kept)
    except OSError as error:
        raise CannotCompare(f"{file}: {error.strerror}; name the results.json of another run, or its folder") from error
    except (ValueError, ArithmeticError, RecursionError) as error:
        raise CannotCompare(f"{file} holds no results of a bench: {error}") from error
    if told.bench not in ("", bench):
        raise CannotCompare(f"{file} is a report of {told.bench}, and this is {bench}: name one of {bench}")
    return Before(file, told.bench, told.about, {one.name: one for one in told.results})


def compare(results: Sequence[Result], facts: dict[str, str], before: Before | None) -> Compared:
    """A run's results and facts with those of the other one, if there is one."""
    if before is None:
        return Compared()
    return Compared((_extent(results, before), *_doubts(facts, before)), regressions(results, before.results))


def _extent(results: Sequence[Result], before: Before) -> str:
    """How much of this run is in the other one, by number, and what is in one of them alone, by name."""
    shared = [(one, before.results[one.name]) for one in results if one.name in before.results]
    figures = [figure.name for one in results for figure in one.figures]
    both = sum(figure.name in old.figures for one, old in shared for figure in one.figures)
    new = [one.name for one in results if one.name not in before.results]
    new += [f"{one.name}: {figure.name}" for one, old in shared for figure in one.figures
            if figure.name not in old.figures]  # fmt: skip
    gone = sorted(set(before.results) - {one.name for one in results})
    text = f"compared with {before.file}: {len(shared)} of {len(results)} outcomes, {both} of {len(figures)} figures"
    text += f"; not in the other: {_some(new)}" if new else ""
    return text + (f"; only in the other: {_some(gone)}" if gone else "")


def _doubts(facts: dict[str, str], before: Before) -> list[str]:
    """Why a difference may come from elsewhere."""
    doubts = [] if before.bench else [f"{before.file} does not say of which bench it is; it is taken for one of this"]
    for name in (*ENDS, *(name for name in facts if name.startswith(SCENARIO))):
        now, then = facts.get(name), before.facts.get(name)
        if now is not None and then is not None and now != then:
            doubts.append(f"{name} differs, and so may figures: {_short(now)}; {_short(then)} then")
    return doubts


def digest(text: str) -> str:
    """By which two texts can be told apart."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _short(text: str) -> str:
    """In a line; of a whole file its digest."""
    return digest(text) if "\n" in text else text


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def regressions(results: Sequence[Result], before: dict[str, Old]) -> dict[str, list[str]]:
    """What has become worse since another run, by the result's name."""
    found = {one.name: _lost(one, before[one.name]) for one in results if one.name in before}
    return {name: lines for name, lines in found.items() if lines}


def _lost(one: Result, old: Old) -> list[str]:
    """How a result is worse than it was."""
    found = []
    if old.outcome == "passed" and one.outcome == "FAILED":
        found.append(f"{one.name} passed then")
    elif old.outcome == "passed" and one.skipped:
        found.append(f"{one.name} passed then, and was not tried now: {one.skipped}")
    found += [
        f"{one.name}: {figure}, {old.figures[figure.name]:.4g} then"
        for figure in one.figures
        if figure.name in old.figures and figure.lost(old.figures[figure.name])
    ]
    if one.passed and not one.skipped:  # otherwise it is said above why there are none
        gone = sorted(
            {figure.name for figure in old.measured if figure.worse} - {figure.name for figure in one.figures}
        )
        found += [f"{one.name}: {name} is not measured any more, {old.figures[name]:.4g} then" for name in gone]
    return found
