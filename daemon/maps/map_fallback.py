"""Fallback from a stored map in its own frame to a new one where light fixes the pose; logs each change.

The stored map becomes an unaligned map, which is found later or abandoned (`estimator.relocalisation.unaligned_map`).
"""

from __future__ import annotations

import logging
import struct
import zlib
from typing import Final

from estimator import LoopReason, StepResult

log = logging.getLogger(__name__)

ASIDE: Final = (
    "lamps tell the place, and the stored map %08x, made without them, does not say where that lies in it: a new map "
    "is begun beside it, the robot is looked for in the stored one on the way, and until then nothing is saved"
)
FOUND: Final = "the robot has been found in the stored map %08x: it lies in the survey's frame now, and is gone on in"
LET_GO: Final = (
    "the robot is nowhere in the stored map %08x, which may be of another place, or of little: what has been mapped "
    "under lamps since is a map of its own from now on. The stored one stays as it is: SWITCH_MAP, or a start with its "
    "file alone in the folder, goes back to it"
)


def another(map_id: int, t_mono: float) -> int:
    """Identity of the map that follows an abandoned or deleted (RESET) one at an instant; never 0.

    It is not the next number. After a switch back to the stored map and a second fallback, a third map starts, and the
    stored content of the second stays.
    """
    return zlib.crc32(struct.pack("<Id", map_id, t_mono)) or 1


def let_go(before: StepResult | None, now: StepResult, map_id: int) -> bool:
    """Log what happened to the map with this ID in a step; return whether the estimator now uses another one."""
    was, gone = (False, 0) if before is None else (before.aside, before.let_go)
    if now.let_go > gone:
        log.warning(LET_GO, map_id)
        return True
    if now.aside and not was:
        log.info(ASIDE, map_id)
    elif was and not now.aside and now.loop is not None and now.loop.reason is LoopReason.PLACED:
        log.info(FOUND, map_id)
    return False
