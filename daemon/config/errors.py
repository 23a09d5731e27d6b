"""Readable messages for errors in the configuration, and the descriptions of its keys.

Each message names the file, the line, the key and the value found. It states the values allowed, the purpose of the key
and an example. For an unknown key it names the nearest valid one.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec

from daemon.config.schema import Config

if TYPE_CHECKING:
    from msgspec import inspect

MOVED: Final = {
    "lidar.serial": 'write lidar.device = "auto:SERIAL", as in "auto:H0906091"',
    "lidar.baud": 'write the rate after the path, as in lidar.device = "/dev/ttyUSB0@115200", or omit it for '
    "automatic detection",
}
"""Keys of earlier versions, and their present replacement."""
LONGEST: Final = 60
"""Characters of a value that a message repeats."""
UNKNOWN: Final = re.compile(r"contains unknown field `(.*)`$", re.DOTALL)
"""Message by which msgspec names an unknown key."""


@dataclass(frozen=True, slots=True)
class Option:
    """Description of one configuration key for users; ``example``: a useful value."""

    path: str
    kind: str
    default: Any
    description: str
    example: Any


@dataclass(frozen=True, slots=True)
class _Problem:
    """One error: ``keys`` is the path in the tree, empty where it concerns no single key; ``words`` is the message.

    ``beside``: text that names the other keys concerned. ``item``: index in a list; None: the whole value.
    """

    keys: tuple[str, ...]
    words: str
    beside: str = ""
    item: int | None = None


@dataclass(frozen=True, slots=True)
class Wrong:
    """One error of the configuration: the message line, and the key (empty where it concerns no single key)."""

    text: str
    path: str


def options(tree: type[msgspec.Struct] = Config) -> list[Option]:
    """All options of a configuration tree in order of declaration."""
    from msgspec import inspect  # takes 10 ms, and only messages need it

    kind = inspect.type_info(tree)
    assert isinstance(kind, inspect.StructType)
    return list(_walk(kind, ""))


def problems(tree: dict[str, Any], name: str, text: str = "") -> list[Wrong]:
    """Find all errors of a tree; each wrong value is removed from it, so that the rest can be checked.

    Args:
        tree: as TOML holds it; valid afterwards, where each error concerns a single key.
        name: of the file or the option that the tree comes from.
        text: of that file, for line numbers.
    """
    found: list[tuple[int, Wrong]] = []
    gone: list[str] = []

    def tell(problem: _Problem) -> None:
        path = ".".join(problem.keys)
        if not any(
            f"`{key}`" in problem.beside for key in gone
        ):  # otherwise the error concerns the default that replaces the removed value
            line = line_of(text, path)
            found.append((line, Wrong(f"{name}:{line}: {problem.words}" if line else f"{name}: {problem.words}", path)))
        gone.append(path)

    for nul in list(_nul(tree, ())):
        tell(nul)
        _take_out(tree, nul)
    while (problem := _first(tree)) is not None:
        tell(problem)
        if not _take_out(tree, problem):
            break
    found.sort(key=lambda one: one[0])
    return [wrong for _, wrong in found]


def _first(tree: dict[str, Any]) -> _Problem | None:
    """First error of the tree; None where the tree is valid."""
    try:
        msgspec.convert(tree, Config)
    except msgspec.ValidationError as error:
        return _explain(str(error), tree)
    return None


def _take_out(tree: dict[str, Any], problem: _Problem) -> bool:
    """Remove the wrong key, or the wrong item of a list; returns whether the key existed.

    The other items of a list stay, with those of the example in front.
    """
    for key in problem.keys[:-1]:
        tree = tree.get(key, {})
    if not problem.keys or (value := tree.pop(problem.keys[-1], None)) is None:
        return False
    if problem.item is not None:
        example = next(option.example for option in options() if option.path == ".".join(problem.keys))
        tree[problem.keys[-1]] = [*value[: problem.item], example[0], *value[problem.item + 1 :]]
    return True


def _nul(tree: dict[str, Any], parents: tuple[str, ...]) -> Iterator[_Problem]:
    """Errors for values with a NUL character.

    TOML can write it, but it ends a name for the operating system. No path or address contains it.
    """
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _nul(value, (*parents, key))
        elif "\0" in str(value):
            keys = (*parents, key)
            yield _Problem(keys, f"`{'.'.join(keys)}` contains the character \\u0000; remove it")


def _explain(message: str, tree: dict[str, Any]) -> _Problem:
    """Turn a message of msgspec, or of a check in `daemon.config.schema`, into a readable error."""
    whole = UNKNOWN.search(message)
    named = whole is not None and whole[1] in tree  # a key of the root may look like a path
    at = None if named else re.search(r" - at `\$\.?([^`]*)`$", message)
    place, message = (at[1], message[: at.start()]) if at else ("", message)
    keys = _keys(place)
    if unknown := UNKNOWN.search(message):
        keys = (*keys, unknown[1])
        path = ".".join(keys)
        moved = f"`{path}` is now part of `lidar.device`: {MOVED.get(path)}"
        table = isinstance(_value(tree, place).get(unknown[1]), dict)
        return _Problem(keys, moved if path in MOVED else f"unknown key `{written(keys)}`{_nearest(path, table)}")
    known = {option.path: option for option in options()}
    if (option := known.get(".".join(keys))) is not None:
        return _Problem(keys, wrong_value(place, _value(tree, place), option), item=_item(place))
    if keys and not isinstance(_value(tree, place), dict):
        inside = ", ".join(sorted({path[len(place) + 1 :].split(".")[0] for path in known if path.startswith(place)}))
        found = _found(_value(tree, place))
        return _Problem(keys, f"`{place}` = {found}: expected a table, [{place}], of {inside}")
    for inner in re.finditer(r"`([a-z_.]+)((?:\[\d+\])?)`(?=, got|$)", message):
        path = f"{place}.{inner[1]}".lstrip(".")
        if (option := known.get(path)) is not None:
            said = re.sub(f",? in {re.escape(inner[0])}", "", message).replace("Expected", "expected", 1)
            words = f"`{path}{inner[2]}`: {said}{_purpose(option)}"
            return _Problem(tuple(path.split(".")), words, said, _item(inner[2]))
    return _Problem(keys, message, message)


def _keys(place: str) -> tuple[str, ...]:
    """Keys on a path, without list indices."""
    return tuple(re.sub(r"\[\d+\]", "", place).split(".")) if place else ()


def _item(place: str) -> int | None:
    """List index of a path; None without one."""
    number = re.search(r"\[(\d+)\]", place)
    return None if number is None else int(number[1])


def _value(tree: Any, place: str) -> Any:
    """Value at a path such as ``lidar.mask.sectors[1]``."""
    for key, number in re.findall(r"([^.\[\]]+)|\[(\d+)\]", place):
        tree = tree[int(number)] if number else tree[key]
    return tree


def wrong_value(place: str, value: object, option: Option) -> str:
    """Message for a wrong value: the value found, the values allowed, the purpose of the key, an example."""
    expected = re.sub("^(?=whole|number|list)", "a ", _kind_at(place, option.kind))
    return f"`{place}` = {_found(value)}: expected {expected}{_purpose(option)}"


def _kind_at(place: str, kind: str) -> str:
    """Allowed values at a path; for a list item such as ``sectors[1][0]``, those of the item."""
    for number in re.findall(r"\[(\d+)\]", place):
        if items := re.fullmatch(r"\[(.*)\](?:, each (.*))?", kind):
            kind = items[1].split(", ")[int(number)] + (f", {items[2]}" if items[2] else "")
        else:
            kind = kind.removeprefix("list of ")
    return kind


def _found(value: object) -> str:
    text = value_text(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def _purpose(option: Option) -> str:
    key = option.path.rpartition(".")[2]
    return f" ({option.description}); as in {key} = {value_text(option.example)}"


def written(keys: tuple[str, ...]) -> str:
    """A key in TOML notation; quotes mark a dot inside a key, which separates nothing."""
    return ".".join(key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else value_text(key) for key in keys)


def _nearest(path: str, table: bool) -> str:
    """Nearest valid key to an unknown one; ``table``: the key holds others."""
    values = [option.path for option in options()]
    tables = sorted({path[: dot.start()] for path in values for dot in re.finditer(r"\.", path)})
    if path in values or path in tables:
        return f": the quotes make this one name; did you mean `{path}`?"
    known = tables if table else values
    last = path.rpartition(".")[2]
    same_name = [other for other in known if other.rpartition(".")[2] == last]
    near = same_name or difflib.get_close_matches(path, known, n=1, cutoff=0.6)
    if not near:
        return "; `lumiloop --print-config` lists all keys"
    return "; did you mean " + " or ".join(f"`{other}`" for other in near[:3]) + "?"


def line_of(text: str, path: str) -> int:
    """Line number of the assignment of the key at ``path``, or of its table; 0 where the text contains neither."""
    table = ""
    best, best_length = 0, 0
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*\[+\s*([^\]]+?)\s*\]", line):
            table = _plain(header[1])
            here = table
        elif key := re.match(r"\s*([\w.\-\"' ]+?)\s*=", line):
            here = f"{table}.{_plain(key[1])}".lstrip(".")
        else:
            continue
        if (path == here or path.startswith(here + ".")) and len(here) > best_length:
            best, best_length = number, len(here)
    return best


def _plain(key: str) -> str:
    return re.sub(r"[\"' ]", "", key)


def _walk(kind: inspect.StructType, prefix: str) -> Iterator[Option]:
    from msgspec import inspect

    for field in kind.fields:
        path = prefix + field.name
        if isinstance(field.type, inspect.StructType):
            yield from _walk(field.type, path + ".")
        else:
            told = _told(field.type)
            example = told.get("examples", [field.default])[0]
            yield Option(path, _kind(field.type), field.default, told.get("description", ""), example)


def _told(kind: inspect.Type) -> dict[str, Any]:
    """Extra JSON schema entries of a key (description, examples), from its type annotation."""
    from msgspec import inspect

    if isinstance(kind, inspect.UnionType):  # an optional type
        return _told(kind.types[0])
    return dict(kind.extra_json_schema or {}) if isinstance(kind, inspect.Metadata) else {}


def _kind(kind: inspect.Type) -> str:
    from msgspec import inspect

    if isinstance(kind, inspect.Metadata):
        return _kind(kind.type)
    if isinstance(kind, inspect.UnionType):
        return _kind(kind.types[0])
    if isinstance(kind, (inspect.IntType, inspect.FloatType)):
        name = "whole number" if isinstance(kind, inspect.IntType) else "number"
        return f"{name}, {kind.ge} to {kind.le}" if kind.ge is not None and kind.le is not None else name
    if isinstance(kind, inspect.BoolType):
        return "true or false"
    if isinstance(kind, inspect.StructType):
        return "table"
    if isinstance(kind, inspect.VarTupleType):
        return f"list of {_kind(kind.item_type)}"
    if isinstance(kind, inspect.TupleType):
        items = [_kind(item).partition(", ") for item in kind.item_types]
        return f"[{', '.join(name for name, _, _ in items)}]" + (f", each {items[0][2]}" if items[0][2] else "")
    return "text"


def value_text(value: object) -> str:
    """A value of the tree in TOML notation."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(value_text(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{written((key,))} = {value_text(item)}" for key, item in value.items()) + " }"
    # a JSON string is a TOML basic string, except that TOML also requires an escaped DEL
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007F")
