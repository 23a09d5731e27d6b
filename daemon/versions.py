"""Which software this is: for recordings and results, so that a figure can be traced to what made it."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Final

_PARTS: Final = ("lumiloop", "numpy", "numba", "llvmlite", "scipy")


def versions() -> dict[str, str]:
    """Name to version of ourselves and of everything that takes part in the arithmetic."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for part in _PARTS:
        try:
            found[part] = version(part)
        except PackageNotFoundError:
            found[part] = "run from its source tree" if part == "lumiloop" else "not installed"
    return found
