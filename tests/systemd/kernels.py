"""Kernels that the tests have compiled anyway, put where an installation of the same sources looks for its own.

Compiling all of them takes a minute or two of a processor. numba keys a function's machine code by its source file's
folder (a digest in a directory's name), its signature, its byte code and the processor, so those of this tree serve an
installation once the directory is named after the installation's folder. Some are left out, to be compiled there.
"""

from __future__ import annotations

from pathlib import Path

from daemon.runtime.warmup import LIGHT, OFFLINE
from tools.bench.vm.image import copy_kernels

INSTALLED = Path("/opt/lumiloop/lib")
LEFT_OUT = 16
"""Of so many kernels one is left out."""


def plant(compiled: Path, sources: Path, cache: Path, root: Path) -> list[Path]:
    """Copy the kernels of ``sources`` for the installation below ``root``; returns what was left out of what it loads.

    Args:
        compiled: this version's directory of compiled kernels, as for `estimator.numerics.jit_cache.CACHE_DIR`.
        sources: folder that they were compiled from.
        cache: CacheDirectory of the service, below ``root``.
        root: the machine's files.
    """
    installed = next((root / INSTALLED.relative_to("/")).glob("python3*/site-packages/estimator"))
    place = cache / compiled.name
    copy_kernels(compiled, sources, place, Path("/", installed.relative_to(root)))
    needed = [path for path in sorted(place.rglob("*.nbi")) if not path.parent.name.startswith(OFFLINE + LIGHT)]
    left_out = [path for path in needed if not path.name.startswith(OFFLINE)][::LEFT_OUT]
    for index in left_out:
        for path in index.parent.glob(f"{index.stem}.*"):
            path.unlink()
    return left_out
