"""Map tiles for display clients, drawn beside the estimator, whose state is only read.

Once a second the loop's thread collects new submaps and keyframes, which are immutable, and a thread of lower priority
draws them (`estimator.mapping.live_grid`). A run is therefore the same with and without clients. Without clients
nothing is drawn.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:  # the warm-up loads the estimator in a thread
    from asyncio import AbstractEventLoop

    from estimator import Cells, Keyframe, LiveGrid, Progress, State, Submap, Task, Tile

log = logging.getLogger(__name__)

RESOLUTION_M: Final = 0.05
JOBS: Final = 8
"""Largest number of consecutive drawing jobs, some 20 ms each."""

AGAIN_S: Final = 30.0
"""Time in s after which failed drawing, for lack of memory perhaps, is tried again."""

Tiles = dict[tuple[int, int], tuple[int, bytes]]
"""By column and row: the version of a tile, and its cells, deflated."""


Shown = tuple[int, tuple[int, int]]
"""A tile's version, column and row."""
NOTHING_SHOWN: Final[Shown] = (0, (0, 0))


class MapTiles:
    """Tiles of the map in use.

    Attributes:
        version: counts changes. tiles: all that were ever non-empty. error: reason why drawing failed, empty on
            success.
    """

    def __init__(self, state: Callable[[], State | None], changed: Callable[[], None]) -> None:
        """``state``: of the estimator, None before it is loaded. ``changed``: is called when there are new tiles."""
        self.version = 0
        self.tiles: Tiles = {}
        self.error = ""
        self._state = state
        self._changed = changed
        self._live: LiveGrid | None = None
        self._frames: dict[int, list[Keyframe]] = {}
        self._seen = 0
        self._busy = False
        self._again = 0.0
        self._thread: ThreadPoolExecutor | None = None

    def follow(self, loop: AbstractEventLoop) -> None:
        """Collect changes of the map and start drawing; call it periodically in the loop's thread."""
        state = self._state()
        if state is None or self._busy or (self.error and loop.time() < self._again):
            return
        self._look(state)
        live, adrift = self._live, _adrift(state)
        if live is not None and live.busy(adrift):
            self._hand_out(live.task(adrift), adrift, JOBS, loop)

    @property
    def busy(self) -> bool:
        """Whether drawing is in progress."""
        return self._busy

    def forget(self) -> None:
        """Discard all tiles, because there are no clients."""
        if not self._busy:
            self.tiles, self._live, self._frames, self._seen = {}, None, {}, 0
            self.version += 1
            self.error = ""

    def close(self) -> None:
        """Stop drawing until the next :meth:`follow`; idempotent."""
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.shutdown(wait=False, cancel_futures=True)
            self._busy = False
            self.forget()

    def since(self, shown: Shown) -> list[tuple[Shown, bytes]]:
        """Tiles after ``shown``, ordered by version, then by column and row."""
        newer = [((version, tile), cells) for tile, (version, cells) in self.tiles.items()]
        return sorted(one for one in newer if one[0] > shown)

    def _look(self, state: State) -> None:
        """Add new keyframes, and remove submaps that the map does not contain any more."""
        from estimator import LiveGrid

        live = self._live
        if live is None:
            live = self._live = LiveGrid(RESOLUTION_M)
        gone = [key for key, submap in live.submaps.items() if not _stands(state, submap)]
        if gone:
            self._let_go(live, gone)
        fresh: dict[int, Submap] = {}
        for frame in _newer(state, self._seen):
            fresh[frame.submap.key] = frame.submap
            self._frames.setdefault(frame.submap.key, []).append(frame)
        if fresh:
            self._seen = max(frames[-1].key for frames in self._frames.values())
        for key in sorted(fresh):
            live.laid(fresh[key], self._frames[key])
        live.due = True  # submaps may have moved
        for key in [key for key in self._frames if key not in live.submaps]:
            del self._frames[key]

    def _let_go(self, live: LiveGrid, gone: list[int]) -> None:
        """Remove submaps of another map or of a discarded part; the area that they showed is drawn again."""
        if len(gone) == len(live.submaps):
            self._seen = 0  # another map
        for key in gone:
            if (drawn := live.drawn.pop(key, None)) is not None:
                live.stale |= drawn.tiles
            del live.submaps[key]
            live.fresh.pop(key, None)
            self._frames.pop(key, None)

    def _hand_out(self, task: Task, adrift: float, left: int, loop: AbstractEventLoop) -> None:
        from estimator import advance

        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "lumiloop-tiles", _step_back)

        live = self._live

        def work() -> None:
            done: tuple[Progress, dict[Tile, bytes]] | None = None
            try:
                progress = advance(task)
                done = progress, {tile: _packed(cells) for tile, cells in progress.tiles.items()}
            except Exception:  # drawing must not affect localisation; the defect is logged in full, once
                if not self.error:
                    log.exception(
                        "the map cannot be drawn for the stream; the daemon tries again every %.0f s", AGAIN_S
                    )
            try:
                loop.call_soon_threadsafe(self._take, live, done, adrift, left, loop)
            except RuntimeError:
                return  # the loop has closed: no client waits any more

        self._thread.submit(work)
        self._busy = True

    def _take(
        self,
        live: LiveGrid | None,
        done: tuple[Progress, dict[Tile, bytes]] | None,
        adrift: float,
        left: int,
        loop: AbstractEventLoop,
    ) -> None:
        """Apply the result of a drawing job, and start the next one."""
        if live is None or live is not self._live:
            return  # it was closed meanwhile
        self._busy = False
        if done is None:
            self.error, self._again = "the map cannot be drawn; read the log", loop.time() + AGAIN_S
            return
        self.error = ""
        progress, packed = done
        before = live.version
        live.take(progress)
        if live.version != before:
            self.version += 1
            for tile, cells in packed.items():
                if live.tiles.get(tile, (0, None))[0] == live.version:
                    self.tiles[tile] = self.version, cells
            self._changed()
        if left > 0 and live.busy(adrift):
            self._hand_out(live.task(adrift), adrift, left - 1, loop)


def _step_back() -> None:
    """Lower the priority of the drawing thread, so that the cycle gets the processor first."""
    try:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
    except OSError:
        log.debug("the priority of the drawing thread cannot be lowered")


def _packed(cells: Cells) -> bytes:
    return zlib.compress(cells.tobytes(), 1)


def _adrift(state: State) -> float:
    return math.inf if state.map.parts.detached is None else float(state.map.parts.detached)


def _stands(state: State, submap: Submap) -> bool:
    """Whether a submap belongs to the map: in the graph itself, or merged into one that is."""
    while state.map.graph.submaps.get(submap.key) is not submap:
        if submap.into is None:
            return False
        submap = submap.into[0]
    return True


def _newer(state: State, seen: int) -> list[Any]:
    """Keyframes created since, oldest first."""
    newer = []
    for key in reversed(state.map.keyframes):
        if key <= seen:
            break
        newer.append(state.map.keyframes[key])
    return newer[::-1]
