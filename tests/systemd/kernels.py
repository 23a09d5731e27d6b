"""Kernels that the tests have compiled anyway, put where an installation of the same sources looks for its own.

Compiling all of them takes a minute or two of a processor; those of this tree serve an installation of the same
sources. Some are left out, to be compiled there.
"""

from pathlib import Path

from daemon.runtime.warmup import LIGHT, OFFLINE
from tools.bench.vm.image import copy_kernels

LEFT_OUT = 16
"""Of so many kernels one is left out."""


def plant(compiled: Path, cache: Path) -> list[Path]:
    """Copy the kernels for an installation; returns what was left out of what it loads.

    Args:
        compiled: this version's directory of compiled kernels, as for `estimator.numerics.jit_cache.CACHE_DIR`.
        cache: CacheDirectory of the service.
    """
    place = cache / compiled.name
    copy_kernels(compiled, place)
    needed = [path for path in sorted(place.rglob("*.nbi")) if not path.parent.name.startswith(OFFLINE + LIGHT)]
    left_out = [path for path in needed if not path.name.startswith(OFFLINE)][::LEFT_OUT]
    for index in left_out:
        for path in index.parent.glob(f"{index.stem}.*"):
            path.unlink()
    return left_out
