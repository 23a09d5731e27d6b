"""Fault orders as data: a TOML schedule with kind, device, time and duration of each fault.

::

    [[fault]]
    what = "bit_flip"     # a word of the device's vocabulary
    where = "lidar"       # which device; optional where only one has the word
    when = 2.0            # seconds after the schedule starts (after the order, when ordered live)
    for = 1.5             # seconds; without `for` and `count` it lasts until it is cleared
    count = 3             # or: how many times it strikes
    every = 10            # strikes at every tenth opportunity only
    share = 0.1           # strikes with this probability
    part = "data"         # the word's own parameters

Each device supplies its own vocabulary, so that orders for a lidar, an ADC and an odometry sender stand in one file. An
unknown word, a wrong key or a value out of range is refused with its path.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Value = float | int | str | bool


class FaultError(ValueError):
    """An invalid order. ``path`` names the place (``fault[2].part``)."""

    def __init__(self, path: str, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path
        self.problem = problem


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a word: its kind is that of its default; numbers lie in [``low``, ``high``]."""

    default: Value
    low: float = float("-inf")
    high: float = float("inf")
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Word:
    """One kind of fault.

    Attributes:
        help: its effect, in one clause.
        kind: ``strikes`` hits single frames or replies (takes ``for count every share``), ``lasts`` is a condition
            (takes ``for``), ``once`` is an event.
        parameters: its own parameters, by name.
        share: default probability of a strike.
    """

    help: str
    kind: Literal["strikes", "lasts", "once"]
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    share: float = 1.0


Vocabulary = Mapping[str, Word]

TIMES = {"when": Parameter(0.0, 0.0)}
LASTING = TIMES | {"for": Parameter(0.0, 0.0)}
STRIKING = LASTING | {"count": Parameter(0, 1), "every": Parameter(1, 1), "share": Parameter(1.0, 0.0, 1.0)}
COMMON = {"once": TIMES, "lasts": LASTING, "strikes": STRIKING}


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """One order. ``lasts`` in seconds, 0: no end of its own; ``count`` strikes, 0: no limit. Compared by identity."""

    what: str
    where: str
    when: float = 0.0
    lasts: float = 0.0
    count: int = 0
    every: int = 1
    share: float = 1.0
    values: Mapping[str, Value] = field(default_factory=dict)

    def number(self, name: str) -> float:
        """A parameter that is a number."""
        return float(self.values[name])

    def text(self, name: str) -> str:
        """A parameter that is a text."""
        return str(self.values[name])

    def __str__(self) -> str:
        shown = {"for": self.lasts, "count": self.count} | dict(self.values)
        return " ".join([f"{self.where}:{self.what}", *(f"{k}={v}" for k, v in shown.items() if v not in (0, ""))])


def _check(path: str, value: Any, rule: Parameter) -> Value:
    kind = type(rule.default)
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise FaultError(path, f"expected a {kind.__name__}, got {value!r}")
    if rule.choices and value not in rule.choices:
        raise FaultError(path, f"{value!r} is not one of {', '.join(rule.choices)}{_near(value, rule.choices)}")
    if isinstance(value, (int, float)) and not rule.low <= value <= rule.high:
        raise FaultError(path, f"{value!r} is outside {rule.low:g}...{rule.high:g}")
    checked: Value = kind(value)
    return checked


def _near(word: Any, known: Iterable[str]) -> str:
    """Suggestion of the closest known word."""
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def _named(table: Mapping[str, Any], path: str, vocabularies: Mapping[str, Vocabulary]) -> tuple[str, str]:
    """Device and word of an order; without a device, the only one whose vocabulary has the word."""
    for key in ("what", "where"):
        if not isinstance(table.get(key, ""), str):
            raise FaultError(f"{path}.{key}", f"expected a text, got {table[key]!r}")
    what, where = table.get("what"), table.get("where")
    able = [name for name, words in vocabularies.items() if len(vocabularies) == 1 or what in words]
    if where is None and len(able) > 1:
        raise FaultError(f"{path}.where", f"name one of {', '.join(able)}")
    if where is None and not able:
        near = _near(what, {word for words in vocabularies.values() for word in words})
        raise FaultError(f"{path}.what", f"{what!r} is not a fault of these devices{near}")
    where = able[0] if where is None else where
    if where not in vocabularies:
        there = sorted(vocabularies)
        problem = f"{where!r} is not a device here; available: {', '.join(there)}"
        raise FaultError(f"{path}.where", f"{problem}{_near(where, there)}")
    if what is None or what not in vocabularies[where]:
        known = sorted(vocabularies[where])
        problem = f"{what!r} is not a fault of {where!r}; available: {', '.join(known)}"
        raise FaultError(f"{path}.what", f"{problem}{_near(what, known)}")
    return where, what


def read_fault(table: Mapping[str, Any], path: str, vocabularies: Mapping[str, Vocabulary]) -> Fault:
    """Check one order against the vocabulary of the device it names.

    Raises:
        FaultError: unknown device, word or key, or a value of the wrong kind or out of range.
    """
    where, what = _named(table, path, vocabularies)
    word = vocabularies[where][what]
    common = COMMON[word.kind]
    rules = {**common, **word.parameters}
    unknown = sorted(set(table) - set(rules) - {"what", "where"})
    if unknown:
        raise FaultError(
            f"{path}.{unknown[0]}", f"{what!r} takes: what, where, {', '.join(rules)}{_near(unknown[0], rules)}"
        )
    given = {key: _check(f"{path}.{key}", value, rules[key]) for key, value in table.items() if key in rules}
    values = {key: given.get(key, rule.default) for key, rule in word.parameters.items()}
    return Fault(
        what=what,
        where=where,
        when=float(given.get("when", 0.0)),
        lasts=float(given.get("for", 0.0)),
        count=int(given.get("count", 0)),
        every=int(given.get("every", 1)),
        share=float(given.get("share", word.share)),
        values=values,
    )


def read_schedule(text: str, vocabularies: Mapping[str, Vocabulary]) -> list[Fault]:
    """Read a TOML schedule.

    Args:
        text: the file's text.
        vocabularies: by device name.

    Raises:
        FaultError: not TOML, or an invalid order; the message begins with the path of the place.
    """
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FaultError("schedule", f"not TOML: {error}") from error
    unknown = sorted(set(tree) - {"fault"})
    if unknown:
        raise FaultError(unknown[0], "a schedule must have only [[fault]] tables")
    tables = tree.get("fault", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise FaultError("fault", "expected [[fault]] tables")
    return [read_fault(table, f"fault[{i}]", vocabularies) for i, table in enumerate(tables)]
