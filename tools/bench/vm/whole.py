"""Whether what is kept is still what was made: a list of its files, written last, that later runs hold them against.

A full disk, a copy that was broken off or a bad card leave files that are there and hold something else. QEMU ends on
these or boots into nothing, which tells nobody what to do.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

NAME: Final = "whole.json"
BLOCK: Final = 1 << 16
"""So many bytes of a large file are looked at: of a disk they hold what its file system says of itself."""
SMALL: Final = 200_000_000
"""Up to so many bytes a file is read to its end, which takes a second at most."""


def note(folder: Path, parts: Sequence[Path]) -> None:
    """Write down what these files of the folder are; the last thing that is written there."""
    (folder / NAME).write_text(json.dumps({part.name: _look(part) for part in parts}))


def lacks(folder: Path, parts: Sequence[Path]) -> str:
    """What is missing, empty or other than it was made; empty text: it is whole."""
    gone = [f"no {part.name}" for part in parts if not part.is_file() or not part.stat().st_size]
    if gone:
        return ", ".join(gone)
    made = _noted(folder / NAME)
    if made is None:
        return f"no readable {NAME}"
    return ", ".join(f"{part.name} is not what was made" for part in parts if made.get(part.name) != _look(part))


def _noted(file: Path) -> dict[str, object] | None:
    with contextlib.suppress(FileNotFoundError, ValueError):
        made = json.loads(file.read_text())
        return made if isinstance(made, dict) else None
    return None


def _look(part: Path) -> list[object]:
    """Size, and a digest of all of it or of its first block."""
    size = part.stat().st_size
    with part.open("rb") as file:
        if size <= SMALL:
            return [size, hashlib.file_digest(file, "sha256").hexdigest()]
        return [size, hashlib.sha256(file.read(BLOCK)).hexdigest()]
