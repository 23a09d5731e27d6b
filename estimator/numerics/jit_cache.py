"""Directory of the on-disk cache of compiled kernels, found without loading the compiler.

Its name is a hash of *all* kernel sources, of the compiler's versions and of its settings. numba's own key does not
cover callees in other files, so an edited callee would leave a stale caller. Nor does it cover the settings from the
environment. So each such setting has a directory of its own: ``NUMBA_BOUNDSCHECK=1`` (every index is checked,
`IndexError`), or ``NUMBA_CPU_NAME=generic`` (baseline instructions of the architecture only).

It touches the file system once, when first imported.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Final

KEPT: Final = 4
"""Number of directories of other sources that are kept, the most recently used."""
KEPT_S: Final = 7 * 86400.0
"""All directories used within this time (s) are kept too, because their programs may be running..."""
MOST: Final = 40
"""...up to this total, some 10 MB each. A running program has its kernels in memory and loses nothing."""

SHAPING: Final = (
    "BOUNDSCHECK",
    "CPU_NAME",
    "CPU_FEATURES",
    "ENABLE_AVX",
    "OPT",
    "LOOP_VECTORIZE",
    "SLP_VECTORIZE",
    "DEBUGINFO_DEFAULT",
)
"""numba settings (environment variables, without their prefix ``NUMBA_``) that affect the machine code."""


def source_key() -> str:
    """Hash of every source file of the estimator and of the versions and settings that affect its machine code."""
    digest = hashlib.sha256()
    room = Path(__file__).parents[1]
    for path in sorted(room.rglob("*.py")):
        digest.update(path.relative_to(room).as_posix().encode())
        digest.update(path.read_bytes())
    versions = (sys.version_info[:2], *(version(name) for name in ("numba", "llvmlite", "numpy")))
    digest.update(repr(versions).encode())
    digest.update(repr([os.environ.get(f"NUMBA_{name}") or "" for name in SHAPING]).encode())
    return digest.hexdigest()[:16]


def _writable(directory: Path) -> bool:
    """Whether a file can be created there."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return True
    except OSError:
        return False


def _has_kernels(directory: Path) -> bool:
    """Whether a directory contains compiled kernels that this process can list."""
    try:
        return any(directory.glob("*/*.nbi"))
    except OSError:
        return False


def _cache_roots() -> list[Path]:
    """Candidates in order: explicit, the service manager's CacheDirectory, the user's cache, a temporary directory."""
    env = os.environ
    named = [env[name] for name in ("NUMBA_CACHE_DIR", "CACHE_DIRECTORY") if env.get(name)]
    home = env.get("XDG_CACHE_HOME") or (str(Path(env["HOME"]) / ".cache") if env.get("HOME") else "")
    roots = [Path(name) for name in named]
    if home:
        roots.append(Path(home) / "lumiloop")
    with contextlib.suppress(OSError):  # no temporary directory can be written to
        roots.append(Path(tempfile.gettempdir()) / f"lumiloop-{os.getuid()}")
    return roots


def _last_used(directory: Path) -> float:
    """Time of the last use of a directory (s, modification time)."""
    try:
        return directory.stat().st_mtime
    except OSError:  # another process has removed it just now
        return 0.0


def _prune(root: Path, ours: Path) -> None:
    """Remove cache directories of other sources; those that cannot be removed stay."""
    now = _last_used(ours)
    others = sorted((path for path in root.glob("kernels-*") if path != ours), key=_last_used, reverse=True)
    for rank, path in enumerate(others):
        if rank >= MOST or (rank >= KEPT and now - _last_used(path) > KEPT_S):
            shutil.rmtree(path, ignore_errors=True)


def _choose_cache() -> Path:
    """Directory of these sources in the first cache root that contains kernels of them or is writable.

    A full or read-only disk with kernels thus serves as it is. Old directories are removed where this one is new.

    Raises:
        RuntimeError: no root is writable, and none contains kernels of these sources.
    """
    key = source_key()
    for root in _cache_roots():
        directory = root / f"kernels-{key}"
        is_new = not os.access(directory, os.F_OK)
        if _writable(directory):
            with contextlib.suppress(OSError):  # the directory of another user
                os.utime(directory)  # marks the last use
            if is_new:
                _prune(root, directory)
            return directory
        if _has_kernels(directory):
            return directory
    raise RuntimeError("no writable directory for compiled kernels; set NUMBA_CACHE_DIR to one")


CACHE_DIR: Final = _choose_cache()
"""Directory of the compiled kernels of exactly these sources."""
