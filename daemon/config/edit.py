"""Changes of single values in the text of a configuration file; comments, order and layout stay."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from daemon.config.errors import value_text

_HEADER: Final = re.compile(r"\s*\[\s*([\w\-. ]+?)\s*\]\s*(#.*)?$")
_KEY: Final = re.compile(r"\s*([\w\-. ]+?)\s*=")


class CannotEdit(Exception):
    """The text cannot be changed without rewriting it; the text of the error names the key."""


@dataclass(frozen=True, slots=True)
class _Assignment:
    """``lines[first:last]`` assign ``value`` to the key at ``path``; ``head``, ``comment``: before and behind it."""

    path: str
    first: int
    last: int
    head: str
    comment: str
    value: Any


def with_values(text: str, values: Mapping[str, object]) -> str:
    """The text with new values of these keys (``lidar.mount.x``); read back it is the old tree with those values.

    Raises:
        CannotEdit: the text is written in a way that this module does not know.
        tomllib.TOMLDecodeError: the text is not TOML.
    """
    for path, value in values.items():
        wanted = tomllib.loads(text)
        _put(wanted, path.split("."), value)
        text = _first_right(_candidates(text, path, value), wanted, path)
    return text


def _first_right(candidates: Iterator[str], wanted: dict[str, Any], path: str) -> str:
    for candidate in candidates:
        try:
            if tomllib.loads(candidate) == wanted:
                return candidate
        except tomllib.TOMLDecodeError:
            continue
    raise CannotEdit(f"`{path}` cannot be set automatically in this file; set it with an editor")


def _put(tree: dict[str, Any], keys: list[str], value: object) -> None:
    for key in keys[:-1]:
        child = tree.setdefault(key, {})
        if not isinstance(child, dict):
            raise CannotEdit(f"`{key}` is a value in this file, not a table")
        tree = child
    tree[keys[-1]] = tomllib.loads(f"v = {value_text(value)}")["v"]


def _candidates(text: str, path: str, value: object) -> Iterator[str]:
    """Texts in which the key may have its new value, the best first."""
    lines = text.splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines[-1] += "\n"
    for found in _assignments(lines):
        if found.path == path:
            yield _replaced(lines, found, value)
        elif path.startswith(f"{found.path}.") and isinstance(found.value, dict):  # an inline table
            inner = dict(found.value)
            _put(inner, path.removeprefix(f"{found.path}.").split("."), value)
            yield _replaced(lines, found, inner)
    parent, _, key = path.rpartition(".")
    new = f"{key} = {value_text(value)}\n"
    yield _inserted(lines, _place(lines, parent, key), new)
    yield "".join([*lines, *(["\n"] if lines else []), f"[{parent}]\n" if parent else "", new])
    yield _inserted(lines, 0, f"{path} = {value_text(value)}\n")


def _replaced(lines: list[str], found: _Assignment, value: object) -> str:
    changed = f"{found.head}{value_text(value)}{found.comment}\n"
    return "".join([*lines[: found.first], changed, *lines[found.last :]])


def _inserted(lines: list[str], at: int, new: str) -> str:
    return "".join([*lines[:at], new, *lines[at:]])


def _place(lines: list[str], table: str, key: str) -> int:
    """Line behind which a key of a table belongs: its own comment (``# key = 1``), else the table's last value."""
    here, last, assigned = "", 0 if not table else len(lines), {found.first: found for found in _assignments(lines)}
    number = 0
    while number < len(lines):
        line = lines[number]
        step = 1
        if header := _HEADER.match(line.rstrip("\n")):
            here = _plain(header[1])
            last = number + 1 if here == table else last
        elif found := assigned.get(number):
            step = found.last - found.first
            last = number + step if here == table else last
        elif here == table and re.match(rf"\s*#\s*{re.escape(key)}\s*=", line):
            return number + 1
        number += step
    return last


def _assignments(lines: list[str]) -> Iterator[_Assignment]:
    """Every assignment of the text, also those that span several lines."""
    table, number = "", 0
    while number < len(lines):
        line = lines[number]
        if header := _HEADER.match(line.rstrip("\n")):
            table = _plain(header[1])
        elif (key := _KEY.match(line)) and (found := _assignment(lines, number, key, table)) is not None:
            yield found
            number = found.last
            continue
        number += 1


def _assignment(lines: list[str], first: int, key: re.Match[str], table: str) -> _Assignment | None:
    """The assignment that begins at a line; it ends where its value is complete."""
    rest = ""
    for last in range(first, len(lines)):
        rest += lines[last] if last > first else lines[last][key.end() :]
        try:
            value = tomllib.loads(f"v ={rest}")["v"]
        except tomllib.TOMLDecodeError:
            continue
        path = f"{table}.{_plain(key[1])}".lstrip(".")
        return _Assignment(path, first, last + 1, f"{key[0].rstrip()} ", _comment(rest.rstrip("\n"), value), value)
    return None


def _comment(rest: str, value: object) -> str:
    """The comment behind a value, with the blanks before it; empty without one."""
    for at in (match.start() for match in re.finditer("#", rest)):
        try:
            if tomllib.loads(f"v ={rest[:at]}")["v"] == value:
                return rest[len(rest[:at].rstrip()) :]
        except tomllib.TOMLDecodeError:
            continue
    return ""


def _plain(key: str) -> str:
    return key.replace(" ", "")
