"""Search for the configuration file: the same places in the same order for every command."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

NAME: Final = "lumiloop.toml"
VARIABLE: Final = "LUMILOOP_CONFIG"
SYSTEM: Final = Path("/etc/lumiloop")


@dataclass(frozen=True, slots=True)
class Source:
    """The configuration file in use.

    Attributes:
        file: None: there is none, and every key has its default. how: by what it was found, empty without a file.
        named: whether the command line names it.
    """

    file: Path | None
    how: str = ""
    named: bool = False

    def __str__(self) -> str:
        return f"{self.file} ({self.how})" if self.file is not None else "built-in values; no file was found"


def places(environment: Mapping[str, str] = os.environ) -> Iterator[tuple[Path, str]]:
    """The files that are looked for, in order, with the name of each place."""
    if named := environment.get(VARIABLE, ""):
        yield Path(named), f"${VARIABLE}"
    yield Path(NAME), "working directory"
    home = environment.get("XDG_CONFIG_HOME") or str(Path(environment.get("HOME", "/")) / ".config")
    yield Path(home) / "lumiloop" / NAME, "user"
    yield SYSTEM / NAME, "system"


def find(named: Path | None, environment: Mapping[str, str] = os.environ) -> Source:
    """The configuration file to use: the one that ``--config`` names, or else the first that exists.

    A file that the environment variable names is used even where it does not exist, so that its absence is reported.
    """
    if named is not None:
        return Source(named, "--config", named=True)
    for path, how in places(environment):
        if how == f"${VARIABLE}" or _there(path):
            return Source(path, how)
    return Source(None)


def _there(path: Path) -> bool:
    """Whether the file exists, or may exist; what cannot be looked at is reported when it is read."""
    try:
        return path.is_file()
    except PermissionError:
        return True
