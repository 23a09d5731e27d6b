"""Configuration loader: reads TOML files and overrides, checks them, and prints the resolved tree or its reference.

All errors are reported at once (`daemon/config/errors.py` has the messages). Printed output (``--print-config``, the
reference in the documentation) can be read again as a configuration.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from daemon.config.edit import CannotEdit, with_values
from daemon.config.endpoints import AUTO
from daemon.config.errors import MOVED, Option, Wrong, line_of, options, problems, value_text
from daemon.config.schema import Config
from daemon.system.atomic_file import write_whole
from daemon.system.regular_file import read_named

__all__ = [
    "MOVED",
    "REFERENCE_HEAD",
    "ConfigError",
    "Option",
    "brought_up",
    "dump",
    "load",
    "options",
    "parsed",
    "reference",
    "refuse_overwriting",
    "schema",
    "template",
    "value_text",
    "write",
    "write_back",
]

REFERENCE_HEAD: Final = """\
# Configuration

Generated from the configuration tree by `lumiloop --reference`; a test keeps it current.

One TOML file holds everything, and every key has a default: an empty file is a valid configuration. Unknown keys and
wrong values are refused, all at once, each with the file, the line, the key, what was found, what is allowed and an
example. `lumiloop check` examines the file, and `lumiloop --schema` prints a JSON schema for editors. `--set KEY=VALUE`
on the command line overrules the file.

Every command uses the first of these files, and names it in its first line of output:

1. the one that `--config FILE` names
2. the one that the environment variable `LUMILOOP_CONFIG` names
3. `lumiloop.toml` in the working directory
4. `lumiloop/lumiloop.toml` in `$XDG_CONFIG_HOME` (by default `~/.config`)
5. `/etc/lumiloop/lumiloop.toml`

`lumiloop config init` writes a file with every key as a comment. `lumiloop config show` prints the file in use and
every value that results. `lumiloop config set KEY=VALUE` changes a value in the file; comments stay.

All keys with their defaults, ready to paste:

"""


MOST_BYTES: Final = 1 << 20
"""Largest size of a configuration file in bytes."""
TEMPLATE_HEAD: Final = """\
# Configuration of lumiloop. Every key has a default: remove the `#` before a line and change its value.
# `lumiloop check` examines this file, `lumiloop config show` prints the values that result.

"""


class ConfigError(Exception):
    """The configuration cannot be used; each line of the text states where, what was expected and the remedy.

    Attributes:
        rest: the configuration without the wrong keys; None: no part can be checked further.
        wrong: the wrong keys.
    """

    def __init__(self, text: str, rest: Config | None = None, wrong: frozenset[str] = frozenset()) -> None:
        super().__init__(text)
        self.rest, self.wrong = rest, wrong


def load(file: Path | None, overrides: Sequence[str] = ()) -> Config:
    """Read a file (None: defaults only), apply ``KEY=VALUE`` overrides, and check the result.

    Raises:
        ConfigError: unreadable, not TOML, unknown keys, or wrong values; all of them, a line each.
    """
    text = _read(file) if file is not None else ""
    name = str(file) if file is not None else "built-in defaults"
    try:
        return _checked(text, name, file, overrides)
    except RecursionError:
        raise ConfigError(f"{name}: not valid TOML: nested too deeply") from None


def _checked(text: str, name: str, file: Path | None, overrides: Sequence[str]) -> Config:
    """The configuration in a text of that name; raises `ConfigError`, and `RecursionError` for deep nesting."""
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        at = re.search(r" \(at line (\d+), column \d+\)$", str(error))
        place = f"{name}:{at[1]}" if at else name
        raise ConfigError(f"{place}: not valid TOML: {error}") from None
    found = problems(tree, name, text)
    for override in overrides:
        try:
            _lay_over(tree, override)
        except ConfigError as error:
            found.append(Wrong(str(error), ""))
        else:
            found += problems(tree, f"--set {override}")
    if found:
        told = "\n".join(wrong.text for wrong in found)
        raise ConfigError(told, _rest(tree, file), frozenset(wrong.path for wrong in found))
    return _anchored(msgspec.convert(tree, Config), file)


def _rest(tree: dict[str, Any], file: Path | None) -> Config | None:
    try:
        return _anchored(msgspec.convert(tree, Config), file)
    except msgspec.ValidationError:
        return None  # an error that concerns no single key cannot be removed


def _anchored(config: Config, file: Path | None) -> Config:
    """The configuration with relative paths resolved from the configuration file, not the working directory."""
    if file is None:
        return config
    here = file.resolve().parent  # an absolute path stays as it is
    if config.lights.survey:
        lights = msgspec.structs.replace(config.lights, survey=str(here / config.lights.survey))
        config = msgspec.structs.replace(config, lights=lights)
    if config.map.folder and config.map.kept:
        config = msgspec.structs.replace(
            config, map=msgspec.structs.replace(config.map, folder=str(here / config.map.folder))
        )
    return config


def naming(file: Path | None, key: str, path: Path) -> str:
    """Source of a wrong file name: ``FILE:LINE`` and the key; the key alone where ``--set`` gives it."""
    try:
        text = file.read_text("utf-8") if file is not None else ""
        told: Any = tomllib.loads(text)
        for part in key.split("."):
            told = told[part]
        if file is not None and (file.resolve().parent / told) == path and (line := line_of(text, key)):
            return f"{file}:{line} names it with `{key}`"
    except (OSError, ValueError, KeyError, TypeError):
        pass  # errors of the configuration itself are reported elsewhere
    return f"`{key}` names it"


def brought_up(tree: dict[str, Any]) -> dict[str, Any]:
    """Convert the resolved tree of an earlier version, as stored in recordings, to the present keys."""
    lidar = dict(tree.get("lidar", {}))
    serial, baud = lidar.pop("serial", ""), lidar.pop("baud", 0)
    device = lidar.get("device", AUTO)
    if serial and device == AUTO:
        lidar["device"] = f"{AUTO}:{serial}"
    elif baud and str(device).startswith("/"):
        lidar["device"] = f"{device}@{baud}"
    return tree | {"lidar": lidar} if lidar else tree


def dump(config: Config) -> str:
    """The whole resolved tree as TOML; reading it back yields an equal tree."""
    lines: list[str] = []
    _dump_table(msgspec.to_builtins(config), "", lines)
    return "\n".join(lines).lstrip("\n") + "\n"


def write(path: Path, config: Config, notes: Sequence[str] = (), force: bool = False) -> None:
    """Write a configuration to a file, atomically; `load` reads it back as an equal tree.

    A new file gets the whole tree. In an existing one, only the values that differ change; its comments stay.

    Args:
        path: of the file.
        config: the configuration.
        notes: lines of comment at the head.
        force: replace an existing file.

    Raises:
        ConfigError: the file exists already, or it cannot be written.
    """
    refuse_overwriting(path, force)
    head = "".join(f"# {note}".rstrip() + "\n" for note in notes)
    text = _changed_to(path, config) if path.exists() else None
    try:
        write_whole(path, f"{head}\n{dump(config) if text is None else text}".lstrip("\n").encode())
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}; free space or name another file") from error


def _changed_to(path: Path, config: Config) -> str | None:
    """The text of a file with the values that make it this configuration; None where that is not possible."""
    try:
        text, before = _read(path), load(path)
        old, new = (_values(msgspec.to_builtins(one)) for one in (before, config))
        changed = with_values(text, {key: value for key, value in new.items() if value != old[key]})
        return changed if _anchored(msgspec.convert(tomllib.loads(changed), Config), path) == config else None
    except (ConfigError, CannotEdit, msgspec.ValidationError):
        return None


def _values(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of a tree by path."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _values(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def write_back(path: Path, values: Mapping[str, object]) -> None:
    """Set single keys of a configuration file; its comments stay. The result is checked before it is written.

    Raises:
        ConfigError: the file cannot be read, changed or written, or a value is wrong.
    """
    text = _read(path) if path.exists() else ""
    try:
        changed = with_values(text, values)
    except (CannotEdit, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from None
    found = problems(tomllib.loads(changed), str(path), changed)
    if found:
        raise ConfigError("\n".join(wrong.text for wrong in found))
    try:
        write_whole(path, changed.encode())
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}; free space or name another file") from error


def template() -> str:
    """A configuration file in which every key stands as a comment, with its meaning and its default."""
    return TEMPLATE_HEAD + "\n".join(_commented("# ")) + "\n"


def refuse_overwriting(path: Path, force: bool) -> None:
    """Raise `ConfigError` where the file exists and ``force`` is not set."""
    if path.exists() and not force:
        raise ConfigError(f"{path} exists already; name another file with --out, or replace it with --force")


def schema() -> str:
    """JSON schema of the tree (2020-12), for editors that complete and check TOML."""
    return msgspec.json.format(msgspec.json.encode(msgspec.json.schema(Config)), indent=2).decode() + "\n"


def reference() -> str:
    """The reference page of the configuration: every key with its meaning, its range and its default."""
    lines = _commented("")
    return REFERENCE_HEAD + "```toml\n" + "\n".join(lines) + "\n```\n"


def _commented(before: str) -> list[str]:
    """Every key with its meaning and its default; ``before``: what stands before the assignments."""
    lines: list[str] = []
    table = ""
    for option in options():
        parent, _, key = option.path.rpartition(".")
        if parent != table:
            table = parent
            lines += ["", f"[{parent}]"]
        lines += [f"# {option.description} ({option.kind})", f"{before}{key} = {value_text(option.default)}"]
    return lines


def _read(file: Path) -> str:
    try:
        return read_named(file, MOST_BYTES).decode()
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file (name an existing one with --config)") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: not UTF-8 text at byte {error.start}") from None
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None


def parsed(override: str) -> tuple[str, object]:
    """Key and value of a text ``KEY=VALUE``; an unquoted word is a string, so that a shell needs no second quotes.

    Raises:
        ConfigError: it has another form.
    """
    path, equals, text = override.partition("=")
    if not equals or not path.strip():
        raise ConfigError(f"{override}: expected KEY=VALUE, for example modbus.port=1502")
    try:
        value: object = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    return path.strip(), value


def _lay_over(tree: dict[str, Any], override: str) -> None:
    try:
        path, value = parsed(override)
    except ConfigError as error:
        raise ConfigError(f"--set {error}") from None
    *parents, key = path.split(".")
    for parent in parents:
        child = tree.setdefault(parent, {})
        if not isinstance(child, dict):
            raise ConfigError(f"--set {override}: `{parent}` is a value, not a table of keys")
        tree = child
    tree[key] = value


def _dump_table(table: dict[str, Any], prefix: str, lines: list[str]) -> None:
    plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
    if prefix:
        lines += ["", f"[{prefix}]"]
    lines += [f"{key} = {value_text(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if key not in plain:
            _dump_table(value, f"{prefix}.{key}".lstrip("."), lines)
