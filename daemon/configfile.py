"""Reads, explains and prints the configuration tree.

An error names the file, the line, the path of the key, what was expected and what the key is for; an unknown key names
the nearest known one. What is printed (``--print-config``, the reference in the documentation) can be pasted back.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from daemon.config import Config
from daemon.endpoints import AUTO
from daemon.wholefile import write_whole

if TYPE_CHECKING:
    from msgspec import inspect

REFERENCE_HEAD: Final = """\
# Configuration

Generated from the configuration tree by `lumiloop --reference`; a test keeps it current.

One TOML file holds everything, and every key has a default: an empty file is a valid configuration. An unknown key or
a wrong value is refused with the file, the line, the key and what was expected. `lumiloop check FILE` says whether a
file is good, `lumiloop check FILE --print-config` prints every value that results, and `lumiloop --schema` prints a
JSON schema for editors. `--set KEY=VALUE` on the command line overrules the file.

All keys with their defaults, ready to paste:

"""


MOVED: Final = {
    "lidar.serial": 'write lidar.device = "auto:SERIAL", as in "auto:H0906091"',
    "lidar.baud": 'write the rate behind the path, as in lidar.device = "/dev/ttyUSB0@115200", or leave it out: it is '
    "found by itself",
}
"""Keys of earlier versions, and what to write instead."""


class ConfigError(Exception):
    """The configuration cannot be used; the text says where, what was expected and what to do."""


@dataclass(frozen=True, slots=True)
class Option:
    """One key of the tree, as people need to know it."""

    path: str
    kind: str
    default: Any
    description: str


def load(file: Path | None, overrides: Sequence[str] = ()) -> Config:
    """Read a file (None: defaults only), lay ``KEY=VALUE`` overrides over it, and check the result.

    Raises:
        ConfigError: unreadable, not TOML, an unknown key, or a wrong value.
    """
    text = _read(file) if file is not None else ""
    name = str(file) if file is not None else "built-in defaults"
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from None
    _convert(tree, name, text)
    for override in overrides:
        _lay_over(tree, override)
        _convert(tree, f"--set {override}", "")
    _refuse_nul(tree, name)
    return _anchored(_convert(tree, name, text), file)


def _refuse_nul(tree: dict[str, Any], name: str, parents: str = "") -> None:
    """TOML can write the character that ends a name for the operating system; no path or address has it."""
    for key, value in tree.items():
        if isinstance(value, dict):
            _refuse_nul(value, name, f"{parents}{key}.")
        elif "\0" in str(value):
            raise ConfigError(f"{name}: `{parents}{key}` holds the character \\u0000; leave it out")


def _anchored(config: Config, file: Path | None) -> Config:
    """The same with paths as seen from the configuration file, not from wherever the process runs."""
    if file is None:
        return config
    here = file.resolve().parent  # an absolute path stays what it is
    if config.lights.survey:
        lights = msgspec.structs.replace(config.lights, survey=str(here / config.lights.survey))
        config = msgspec.structs.replace(config, lights=lights)
    if config.map.folder and config.map.kept:
        config = msgspec.structs.replace(
            config, map=msgspec.structs.replace(config.map, folder=str(here / config.map.folder))
        )
    return config


def brought_up(tree: dict[str, Any]) -> dict[str, Any]:
    """The resolved tree of an earlier version, as recordings hold it, in the keys of this one."""
    lidar = dict(tree.get("lidar", {}))
    serial, baud = lidar.pop("serial", ""), lidar.pop("baud", 0)
    device = lidar.get("device", AUTO)
    if serial and device == AUTO:
        lidar["device"] = f"{AUTO}:{serial}"
    elif baud and str(device).startswith("/"):
        lidar["device"] = f"{device}@{baud}"
    return tree | {"lidar": lidar} if lidar else tree


def options() -> list[Option]:
    """Every option of the tree in order of declaration."""
    from msgspec import inspect  # costs 10 ms, and only explanations need it

    kind = inspect.type_info(Config)
    assert isinstance(kind, inspect.StructType)
    return list(_walk(kind, ""))


def dump(config: Config) -> str:
    """The whole resolved tree as TOML; reading it back yields an equal tree."""
    lines: list[str] = []
    _dump_table(msgspec.to_builtins(config), "", lines)
    return "\n".join(lines).lstrip("\n") + "\n"


def write(path: Path, config: Config, notes: Sequence[str] = (), force: bool = False) -> None:
    """Write the whole resolved tree as a file, whole or not at all; `load` reads it back as an equal tree.

    Args:
        path: where to.
        config: what.
        notes: lines of comment at the head.
        force: replace a file that is there.

    Raises:
        ConfigError: there is such a file already, or it cannot be written.
    """
    refuse_overwriting(path, force)
    head = "".join(f"# {note}".rstrip() + "\n" for note in notes)
    try:
        write_whole(path, f"{head}\n{dump(config)}".lstrip("\n").encode())
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}; free space or name another file") from error


def refuse_overwriting(path: Path, force: bool) -> None:
    """Raises `ConfigError` where there is a file that nobody asked to be replaced."""
    if path.exists() and not force:
        raise ConfigError(f"{path} exists: name another file with --out, or ask for it to be replaced with --force")


def schema() -> str:
    """JSON schema of the tree (2020-12), for editors that complete and check TOML."""
    return msgspec.json.format(msgspec.json.encode(msgspec.json.schema(Config)), indent=2).decode() + "\n"


def reference() -> str:
    """The documentation page: every key with its meaning, its range and its default."""
    lines: list[str] = []
    table = ""
    for option in options():
        parent, _, key = option.path.rpartition(".")
        if parent != table:
            table = parent
            lines += ["", f"[{parent}]"]
        lines += [f"# {option.description} ({option.kind})", f"{key} = {value_text(option.default)}"]
    return REFERENCE_HEAD + "```toml\n" + "\n".join(lines) + "\n```\n"


def _read(file: Path) -> str:
    try:
        return file.read_bytes().decode()
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file (name an existing one, or leave --config out for defaults)") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: not UTF-8 text at byte {error.start}") from None
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None


def _lay_over(tree: dict[str, Any], override: str) -> None:
    path, equals, text = override.partition("=")
    if not equals or not path.strip():
        raise ConfigError(f"--set {override}: expected KEY=VALUE, for example --set modbus.port=1502")
    try:
        value: object = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is a string, so that a shell needs no second quotes
    *parents, key = path.strip().split(".")
    for parent in parents:
        child = tree.setdefault(parent, {})
        if not isinstance(child, dict):
            raise ConfigError(f"--set {override}: `{parent}` is a value, not a table of keys")
        tree = child
    tree[key] = value


def _convert(tree: dict[str, Any], name: str, text: str) -> Config:
    try:
        return msgspec.convert(tree, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(str(error), name, text)) from None


def _explain(message: str, name: str, text: str) -> str:
    path = match[1] if (match := re.search(r"at `\$\.?([^`]*)`", message)) else ""
    if unknown := re.search(r"contains unknown field `([^`]*)`", message):
        path = f"{path}.{unknown[1]}".lstrip(".")
        message = f"unknown key `{path}`{_nearest(path)}"
        if path in MOVED:
            message = f"`{path}` is now part of `lidar.device`: {MOVED[path]}"
    else:
        message = message.replace("Expected `array`, got", 'Expected `array`, a list in brackets as in ["..."], got')
        if inner := re.search(r"`([a-z_.]+)(\[\d+\])?`(, got|$| -)", message):
            candidate = f"{path}.{inner[1]}".lstrip(".")
            path = candidate if candidate in _descriptions() else path
        message += _purpose(path)
    line = _line_of(text, path)
    return f"{name}:{line}: {message}" if line else f"{name}: {message}"


def _nearest(path: str) -> str:
    known = list(_descriptions())
    last = path.rpartition(".")[2]
    same_name = [other for other in known if other.rpartition(".")[2] == last]
    near = same_name or difflib.get_close_matches(path, known, n=1, cutoff=0.6)
    if not near:
        return "; `lumiloop --print-config` lists all keys"
    return "; did you mean " + " or ".join(f"`{other}`" for other in near[:3]) + "?"


def _purpose(path: str) -> str:
    description = _descriptions().get(re.sub(r"\[.*", "", path), "")
    return f" ({description})" if description else ""


def _descriptions() -> dict[str, str]:
    return {option.path: option.description for option in options()}


def _line_of(text: str, path: str) -> int:
    """Line of the assignment that holds the key at ``path``, or of its table; 0 where neither is written out."""
    wanted = re.sub(r"\[\d+\]", "", path)
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
        if (wanted == here or wanted.startswith(here + ".")) and len(here) > best_length:
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
            yield Option(path, _kind(field.type), field.default, _description(field.type))


def _description(kind: inspect.Type) -> str:
    from msgspec import inspect

    found = (kind.extra_json_schema or {}).get("description", "") if isinstance(kind, inspect.Metadata) else ""
    return str(found)


def _kind(kind: inspect.Type) -> str:
    from msgspec import inspect

    if isinstance(kind, inspect.Metadata):
        return _kind(kind.type)
    if isinstance(kind, (inspect.IntType, inspect.FloatType)):
        name = "whole number" if isinstance(kind, inspect.IntType) else "number"
        return f"{name}, {kind.ge} to {kind.le}" if kind.ge is not None and kind.le is not None else name
    if isinstance(kind, inspect.BoolType):
        return "true or false"
    return "list" if isinstance(kind, inspect.VarTupleType) else "text"


def _dump_table(table: dict[str, Any], prefix: str, lines: list[str]) -> None:
    plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
    if prefix:
        lines += ["", f"[{prefix}]"]
    lines += [f"{key} = {value_text(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if key not in plain:
            _dump_table(value, f"{prefix}.{key}".lstrip("."), lines)


def value_text(value: object) -> str:
    """A value of the tree as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(value_text(item) for item in value) + "]"
    # a JSON string is a TOML basic string, except that TOML wants DEL escaped too
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007F")
