"""What is known of the keys of the configuration, and what is wrong with one, in words for who writes it.

Each problem names the file, the line, the key, what was found, what is allowed, what the key is for and an example; an
unknown key names the nearest known one.
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
    "lidar.baud": 'write the rate behind the path, as in lidar.device = "/dev/ttyUSB0@115200", or leave it out: it is '
    "found by itself",
}
"""Keys of earlier versions, and what to write instead."""
LONGEST: Final = 60
"""Characters of a value that are repeated."""
UNKNOWN: Final = re.compile(r"contains unknown field `(.*)`$", re.DOTALL)
"""How the library names a key that it does not know."""


@dataclass(frozen=True, slots=True)
class Option:
    """One key of the tree, as people need to know it; ``example``: a value that means something."""

    path: str
    kind: str
    default: Any
    description: str
    example: Any


@dataclass(frozen=True, slots=True)
class _Problem:
    """What is wrong: ``keys`` lead to it through the tree, empty where it is not one key; ``words`` say it.

    ``beside``: what names the other keys that it is about. ``item``: which one of a list it is; None: all of it.
    """

    keys: tuple[str, ...]
    words: str
    beside: str = ""
    item: int | None = None


@dataclass(frozen=True, slots=True)
class Wrong:
    """One thing that is wrong: the line that says it, and the key (empty where it is not one)."""

    text: str
    path: str


def options(tree: type[msgspec.Struct] = Config) -> list[Option]:
    """Every option of a tree in order of declaration."""
    from msgspec import inspect  # costs 10 ms, and only explanations need it

    kind = inspect.type_info(tree)
    assert isinstance(kind, inspect.StructType)
    return list(_walk(kind, ""))


def problems(tree: dict[str, Any], name: str, text: str = "") -> list[Wrong]:
    """Everything that is wrong with a tree; what is wrong is taken out, so that the rest can be judged.

    Args:
        tree: as TOML holds it; good afterwards, where each problem is that of one key.
        name: of the file or the option that it comes from.
        text: of that file, for the numbers of lines.
    """
    found: list[tuple[int, Wrong]] = []
    gone: list[str] = []

    def tell(problem: _Problem) -> None:
        path = ".".join(problem.keys)
        if not any(f"`{key}`" in problem.beside for key in gone):  # else it is about the value that stands in for that
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
    """What is found wrong first; None where the tree is good."""
    try:
        msgspec.convert(tree, Config)
    except msgspec.ValidationError as error:
        return _explain(str(error), tree)
    return None


def _take_out(tree: dict[str, Any], problem: _Problem) -> bool:
    """Whether there was such a key; of a list the other items stay, beside the example's first."""
    for key in problem.keys[:-1]:
        tree = tree.get(key, {})
    if not problem.keys or (value := tree.pop(problem.keys[-1], None)) is None:
        return False
    if problem.item is not None:
        example = next(option.example for option in options() if option.path == ".".join(problem.keys))
        tree[problem.keys[-1]] = [*value[: problem.item], example[0], *value[problem.item + 1 :]]
    return True


def _nul(tree: dict[str, Any], parents: tuple[str, ...]) -> Iterator[_Problem]:
    """TOML can write the character that ends a name for the operating system; no path or address has it."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _nul(value, (*parents, key))
        elif "\0" in str(value):
            keys = (*parents, key)
            yield _Problem(keys, f"`{'.'.join(keys)}` holds the character \\u0000; leave it out")


def _explain(message: str, tree: dict[str, Any]) -> _Problem:
    """What the library says, or a check of `daemon.config.schema`, in words for who writes the file."""
    whole = UNKNOWN.search(message)
    named = whole is not None and whole[1] in tree  # a key of the root may look as if it named a place, too
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
    """Keys of a place without what counts items of lists."""
    return tuple(re.sub(r"\[\d+\]", "", place).split(".")) if place else ()


def _item(place: str) -> int | None:
    """Which item of a list a place is in."""
    number = re.search(r"\[(\d+)\]", place)
    return None if number is None else int(number[1])


def _value(tree: Any, place: str) -> Any:
    """What the tree holds at a place such as ``lidar.mask.sectors[1]``."""
    for key, number in re.findall(r"([^.\[\]]+)|\[(\d+)\]", place):
        tree = tree[int(number)] if number else tree[key]
    return tree


def wrong_value(place: str, value: object, option: Option) -> str:
    """What is said of a value that its key cannot have: what was found, what is allowed, what it is for, an example."""
    expected = re.sub("^(?=whole|number|list)", "a ", _kind_at(place, option.kind))
    return f"`{place}` = {_found(value)}: expected {expected}{_purpose(option)}"


def _kind_at(place: str, kind: str) -> str:
    """What is allowed at a place: of an item of a list, ``sectors[1][0]``, what is allowed of that."""
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
    """A key as TOML writes it: quotes show that a dot within them divides nothing."""
    return ".".join(key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else value_text(key) for key in keys)


def _nearest(path: str, table: bool) -> str:
    """What may be meant by an unknown key; ``table``: it holds others."""
    values = [option.path for option in options()]
    tables = sorted({path[: dot.start()] for path in values for dot in re.finditer(r"\.", path)})
    if path in values or path in tables:
        return f": quotes make one name of it; did you mean `{path}`?"
    known = tables if table else values
    last = path.rpartition(".")[2]
    same_name = [other for other in known if other.rpartition(".")[2] == last]
    near = same_name or difflib.get_close_matches(path, known, n=1, cutoff=0.6)
    if not near:
        return "; `lumiloop --print-config` lists all keys"
    return "; did you mean " + " or ".join(f"`{other}`" for other in near[:3]) + "?"


def line_of(text: str, path: str) -> int:
    """Line of the assignment that holds the key at ``path``, or of its table; 0 where neither is written out."""
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
    """What the tree says of a key."""
    from msgspec import inspect

    if isinstance(kind, inspect.UnionType):  # of something, or nothing
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
    """A value of the tree as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(value_text(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{written((key,))} = {value_text(item)}" for key, item in value.items()) + " }"
    # a JSON string is a TOML basic string, except that TOML wants DEL escaped too
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007F")
