"""Software versions and build digest, stored in recordings and results to make every figure traceable."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
_PARTS: Final = ("lumiloop", "numpy", "numba", "llvmlite", "scipy")
_ROOMS: Final = ("daemon", "estimator", "hal")
"""Packages whose sources affect a pose."""
_LONGEST: Final = 40
"""Longest version text that is accepted from a recording."""


def versions() -> dict[str, str]:
    """Versions by name: this project and every library that takes part in the computation.

    ``build`` is equal wherever the same sources run. ``commit`` is present where the sources are a git tree.
    """
    found = {"python": platform.python_version(), "machine": platform.machine(), "build": build()}
    if commit := _commit(ROOT):
        found["commit"] = commit
    return found | {part: release(part) for part in _PARTS}


def release(part: str = "lumiloop") -> str:
    """Version of a package as installed."""
    try:
        return version(part)
    except PackageNotFoundError:
        return "run from its source tree" if part == "lumiloop" else "not installed"


@lru_cache(maxsize=1)
def build() -> str:
    """Digest of the sources at the first call; a version number alone does not distinguish two commits."""
    digest = hashlib.sha256()
    for path in sorted(path for room in _ROOMS for path in (ROOT / room).rglob("*.py")):
        digest.update(f"{path.relative_to(ROOT)}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def made_elsewhere(header: Mapping[str, Any]) -> str:
    """Sentence that states how the software of a recording differs from the present software.

    Empty if both are equal, or if the ``header`` contains no versions. Another commit of the same sources is equal.
    """
    told, ours = header.get("versions"), versions()
    if not isinstance(told, dict):
        return ""
    other = [part for part in ours.keys() | {"commit"} if part in told and told[part] != ours.get(part)]
    if set(other) <= {"commit"}:
        return ""
    order = sorted(other, key=("lumiloop", "build", "commit", *sorted(ours)).index)
    theirs = ", ".join(f"{part} {_readable(told[part])}" for part in order)
    here = ", ".join(f"{part} {ours[part]}" for part in order if part in ours)
    return f"recorded with {theirs}; this is {here}, so the replay may differ from the recorded run"


def _readable(told: object) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in str(told)[:_LONGEST])


def _commit(root: Path) -> str:
    """Commit of a git tree or worktree; empty where the folder is neither."""
    git = root / ".git"
    try:
        if git.is_file():
            git = root / git.read_text().removeprefix("gitdir:").strip()
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head[:12]
        name, shared = head.removeprefix("ref: "), git / "commondir"
        common = git / shared.read_text().strip() if shared.exists() else git
        if (common / name).is_file():
            return (common / name).read_text()[:12]
        packed = (common / "packed-refs").read_text().splitlines()
        return next((line[:12] for line in packed if line.endswith(f" {name}")), "")
    except (OSError, UnicodeDecodeError):
        return ""
