"""The drive outside of the emulated computer, in virtual time: what its poses are compared with.

It comes out the same each time, so it is driven once for the sources that it depends on, and kept beside the image.
``python -m tools.bench.vm.reference`` drives it if it has not been.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from tools.bench.vm.image import ROOT, digest
from tools.bench.vm.places import cache

if TYPE_CHECKING:
    from tools.bench.world.agreement import Trace

SOURCES: Final = ("daemon", "estimator", "hal", "tools/bench/vm/world.py", "tools/bench/world", "tools/sim")
DRIVE_S: Final = 30.0


def outside() -> Trace:
    """Its errors along the way. The first call of these sources takes half a minute."""
    from tools.bench.world.agreement import Trace  # here: with it comes the estimator, which takes long to load

    file = cache() / f"outside-{digest(*(ROOT / source for source in SOURCES), Path(__file__))}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError), np.load(file) as kept:
        return Trace(kept["driven"], kept["off"])
    made = _driven()
    with contextlib.suppress(OSError):  # who may only read the cache drives anew
        part = file.with_name(f"part-{os.getpid()}.npz")
        np.savez(part, driven=made.driven, off=made.off)
        for old in cache().glob("outside-*"):
            old.unlink()
        part.replace(file)
    return made


def _driven() -> Trace:
    from tools.bench.vm import world
    from tools.bench.world.agreement import reference_of
    from tools.bench.world.room import room
    from tools.sim.scene import SimulatedScene

    return reference_of(SimulatedScene(world.scenario(), room()), world.DWELL_S + DRIVE_S + 10.0)


if __name__ == "__main__":
    outside()
