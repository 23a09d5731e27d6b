"""Readable messages for errors in a lamp survey, all of them at once.

Each message names the file, the line, the lamp, the key and the value found. It states the values allowed, the purpose
of the key and an example. For an unknown key it names the nearest valid one.
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import msgspec

from daemon.config.errors import Option, options, value_text, written, wrong_value
from daemon.config.survey_schema import LampEntry, ReceiverEntry, SurveyTree, last_code
from estimator import Profile

NEAREST_M: Final = 0.01
"""Distance in m below which two lamps are one lamp written twice."""
HEADROOM_M: Final = 0.2
"""Smallest height of a lamp above the receiver, m."""


@dataclass(frozen=True, slots=True)
class _Judged:
    """Check result of one table: its errors ``wrong`` (key or empty; message), and the valid values ``good`` by key."""

    wrong: list[tuple[str, str]]
    good: dict[str, Any]

    def has(self, *keys: str) -> bool:
        """Whether all these keys are valid, so that they can be compared with those of others."""
        return self.good.keys() >= set(keys)


def problems(tree: dict[str, Any], name: str, text: str, profile: Profile | None = None) -> list[str]:
    """All errors of a survey, a line each, in the order of the file.

    Args:
        tree: as TOML holds it.
        name: of the file.
        text: of the file, for line numbers.
        profile: air interface that the lamps must have; None: any.
    """
    lines = _Lines(text)
    lamps, receiver = tree.get("lamp"), tree.get("receiver")
    listed = lamps if isinstance(lamps, list) else []
    judged = [_judge(lamp, LampEntry) for lamp in listed]
    eye = _judge({} if receiver is None else receiver, ReceiverEntry)
    sound: dict[str, Any] = {}  # errors inside them are reported separately
    if isinstance(lamps, list):
        sound["lamp"] = [_stand_ins(LampEntry)] * bool(lamps)
    if receiver is not None:
        sound["receiver"] = {}
    found = [(lines.of(key), words) for key, words in _judge(tree | sound, SurveyTree).wrong]
    found += [(lines.of(key, table="receiver"), f"receiver: {words}") for key, words in eye.wrong]
    for at, lamp in enumerate(judged):
        found += [(lines.of(key, at), f"{_named(lamp, at)}: {words}") for key, words in lamp.wrong]
    found += _numbers(judged, lines) + _places(judged, eye, lines)
    found += _codes(judged, lines, profile) if profile is not None else []
    found.sort(key=lambda one: one[0])
    return [f"{name}:{line}: {words}" if line else f"{name}: {words}" for line, words in found]


def _named(lamp: _Judged, at: int) -> str:
    return f"lamp {lamp.good['lamp_id']}" if lamp.has("lamp_id") else f"lamp[{at}]"


def _judge(table: object, kind: type[msgspec.Struct]) -> _Judged:
    """Check every key by itself, then run the table's own check on the valid ones."""
    try:
        return _Judged([], msgspec.structs.asdict(msgspec.convert(table, kind)))
    except msgspec.ValidationError:
        pass  # this check names the first error only; all are wanted
    if not isinstance(table, dict):
        return _Judged([("", f"expected a table, {{ ... }}, of {', '.join(kind.__struct_fields__)}")], {})
    known = _known(kind)
    wrong = [(key, f"unknown key `{written((key,))}`; {_nearest(key, kind)}") for key in table if key not in known]
    good = {}
    for field in msgspec.structs.fields(kind):
        if words := _wrong(table, field, known[field.name]):
            wrong.append((field.name if field.name in table else "", words))
        else:
            good[field.name] = table.get(field.name, field.default)
    try:
        msgspec.convert(_stand_ins(kind) | {key: good[key] for key in good if key in table}, kind)
    except msgspec.ValidationError as error:
        wrong.append(("", str(error).replace("Expected", "expected", 1)))
    return _Judged(wrong, good)


def _wrong(table: dict[str, Any], field: msgspec.structs.FieldInfo, option: Option) -> str:
    """Error message for one key; empty: valid."""
    if field.name not in table:
        said = f"`{field.name}` is missing: {option.description}; as in {field.name} = {value_text(option.example)}"
        return said if field.required else ""
    try:
        msgspec.convert(table[field.name], field.type)
    except msgspec.ValidationError:
        return wrong_value(field.name, table[field.name], option)
    return ""


@cache
def _known(kind: type[msgspec.Struct]) -> dict[str, Option]:
    return {option.path: option for option in options(kind)}


def _stand_ins(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """A valid table with the required keys only."""
    known = _known(kind)
    return {field.name: known[field.name].example for field in msgspec.structs.fields(kind) if field.required}


def _nearest(key: str, kind: type[msgspec.Struct]) -> str:
    names = kind.__struct_fields__
    near = difflib.get_close_matches(key, names, n=1)
    return f"did you mean `{near[0]}`?" if near else f"known here are {', '.join(names)}"


def _numbers(lamps: list[_Judged], lines: _Lines) -> list[tuple[int, str]]:
    """Errors for lamps with the number of another lamp."""
    found, seen = [], dict[int, int]()
    for at, lamp in enumerate(lamps):
        if lamp.has("lamp_id") and (number := lamp.good["lamp_id"]) in seen:
            words = f"lamp {number}: another lamp has this `lamp_id`{_by_line(lines.of('', seen[number]))}"
            found.append((lines.of("", at), words))
        elif lamp.has("lamp_id"):
            seen[number] = at
    return found


def _places(lamps: list[_Judged], eye: _Judged, lines: _Lines) -> list[tuple[int, str]]:
    """Errors for lamps at an impossible position, or at that of another lamp."""
    found, hung = [], list[tuple[int, _Judged]]()
    for at, lamp in enumerate(lamps):
        if lamp.has("z") and eye.has("z") and lamp.good["z"] < eye.good["z"] + HEADROOM_M:
            words = f"is at z = {lamp.good['z']} m, not above the receiver (z = {eye.good['z']} m)"
            found.append((lines.of("", at), f"{_named(lamp, at)}: {words}"))
        if not lamp.has("x", "y", "z"):
            continue
        other = next((other for other in hung if math.dist(_place(lamp), _place(other[1])) < NEAREST_M), None)
        if other is not None:
            words = f"has the position of {_named(other[1], other[0])}{_by_line(lines.of('', other[0]))}"
            found.append((lines.of("", at), f"{_named(lamp, at)}: {words}; correct or delete one of them"))
        hung.append((at, lamp))
    return found


def _place(lamp: _Judged) -> tuple[float, float, float]:
    return lamp.good["x"], lamp.good["y"], lamp.good["z"]


def _by_line(line: int) -> str:
    return f" in line {line}" if line else ""


def _codes(lamps: list[_Judged], lines: _Lines, profile: Profile) -> list[tuple[int, str]]:
    """Errors for lamps whose code does not exist in the profile."""
    return [
        (
            lines.of("code", at),
            f"{_named(lamp, at)}: code {lamp.good['code']} is not in profile {profile.name}, which has codes "
            f"0 to {last_code(profile)}; correct it, or `photodiode.profile`",
        )
        for at, lamp in enumerate(lamps)
        if lamp.has("code") and lamp.good["code"] > last_code(profile)
    ]


class _Lines:
    """Line numbers of tables and keys in the text of a survey, from 1; 0: not found."""

    def __init__(self, text: str) -> None:
        self._lines = [line.partition("#")[0] for line in text.splitlines()]
        if any(re.match(r"\s*\[\[", line) for line in self._lines):
            self._lamps = self._matching(r"\s*\[\[\s*lamp\s*\]\]")
        else:
            first = next(iter(self._matching(r"\s*lamp\s*=")), len(self._lines))
            self._lamps = [at for at in self._matching(r"[^{]*\{") if first <= at < self._after(first)]

    def of(self, key: str, lamp: int | None = None, table: str = "") -> int:
        """Line of a key of a lamp, of a table, or of the root; if the key has none, that of the lamp or table."""
        first, last = self._span(lamp, table)
        form = re.compile(rf"\s*{re.escape(key)}\s*=")
        own = next((at for at in range(first, last) if key and form.match(self._lines[at])), None)
        if own is not None:
            return own + 1
        return first + 1 if (lamp is not None or table) and first < last else 0

    def _matching(self, form: str) -> list[int]:
        return [at for at, line in enumerate(self._lines) if re.match(form, line)]

    def _after(self, first: int) -> int:
        """Line after the value that starts in a line: the next key or table."""
        later = self._matching(r"\s*(\w+\s*=|\[\s*\w+\s*\])")
        return next((at for at in later if at > first), len(self._lines))

    def _span(self, lamp: int | None, table: str) -> tuple[int, int]:
        """Lines of a lamp or table: the first, and the one after the last; an empty span where it does not exist."""
        end = len(self._lines)
        if lamp is None:
            begins = self._matching(rf"\s*(\[\s*{table}\s*\]|{table}\s*=)") if table else [0]
            if begins and table and "[" not in self._lines[begins[0]].partition("=")[0]:
                return begins[0], begins[0] + 1
            return (begins[0], end) if begins else (0, 0)
        if lamp >= len(self._lamps):
            return 0, 0
        return self._lamps[lamp], self._lamps[lamp + 1] if lamp + 1 < len(self._lamps) else end
