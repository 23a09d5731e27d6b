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
    "the light solution gives the pose in the survey, but the stored map %08x is not aligned to the survey. "
    "The daemon begins a new map and searches for the pose in the stored one. It saves no map until then"
)
FOUND: Final = "the pose in the stored map %08x was found. The map is now aligned to the survey, and the daemon uses it"
LET_GO: Final = (
    "the pose was not found in the stored map %08x, which may be of another building or too small. The new "
    "map is now a separate map, and the stored one remains unchanged. To use the stored map, send "
    "SWITCH_MAP, or start with only its file in the folder"
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
