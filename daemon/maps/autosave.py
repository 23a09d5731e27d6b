"""Map autosave: saves the map on a schedule, on command and at the stop, in a thread of its own.

The loop's thread only collects references (`estimator.stored_map.image_of`). The thread packs and writes, and pauses
between slices of a fraction of a millisecond. Only one of the two can hold the interpreter lock at a time.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.maps.container import BadMap
from daemon.maps.generations import said
from daemon.maps.start_trial import PROOF_S
from daemon.maps.store import Start, Store
from daemon.system.callbacks import OnDone
from daemon.system.versions import release
from hal.blocking_calls import run_in_thread
from hal.clock import Clock

if TYPE_CHECKING:  # the warm-up loads the estimator in a thread
    from estimator import MapImage, State

log = logging.getLogger(__name__)

BEAT_S: Final = 1.0
FIRST_S: Final = 60.0
"""Time in s to the first save: a map that has grown for a minute is worth storing."""
EVERY_S: Final = 300.0
"""Interval of later saves, s. What a power cut loses is mapped again on the next pass, and memory cards wear."""
RETRY_S: Final = 60.0
LOOK_S: Final = 10.0
"""Interval in s of attempts to lock a folder that could not be locked at the start, whether a save is due or not."""
BREATH_S: Final = 0.0005
"""Pause between two slices of packing, s."""
STOP_S: Final = 4.0
"""Time limit in s of the save at the stop; the service manager waits for ten seconds."""

DONE: Final = ""
NO_MAP: Final = "the map is still empty; drive a metre or two"
NO_FOLDER: Final = "maps are not stored, because `map.folder` is none"
FIXED: Final = "the stored map does not change, because `map.localise` is true"
ADRIFT: Final = "the pose in the stored map is not known yet, and the map has not changed"

Revision = tuple[int, int, int]
End = Callable[[Path | None, str], None]
"""Completion callback of a save, in the loop's thread: the file, or None and the reason of the failure."""


@dataclass(frozen=True, slots=True)
class About:
    """Metadata of every map of a run.

    Attributes:
        robot: name of the configuration. survey: digest of the lamp survey, empty without. localise: never saved.
    """

    robot: str = ""
    survey: str = ""
    localise: bool = False


class MapAutosaver:
    """Saves the map of a running estimator.

    Attributes:
        error: reason why the latest save failed, empty on success. saves: number so far.
        busy_since: start of the save in progress (`time.monotonic`, s), None: none.
    """

    def __init__(
        self,
        store: Store | None,
        start: Start | None,
        state: Callable[[], State | None],
        map_id: Callable[[], int],
        about: About,
        clock: Clock,
    ) -> None:
        """Nothing starts before :meth:`run`. ``state``: None while the estimator is loaded."""
        self.error = "" if store is None else store.trouble
        self.saves = 0
        self.busy_since: float | None = None
        self._store, self._start, self._state, self._map_id = store, start, state, map_id
        self._about, self._clock = about, clock
        self._saved: Revision | None = None  # the revision that is on the disk
        self._map_of = map_id()
        self._anew = self._last = False
        self._proved_at, self._lasted = math.inf, False
        self._due = clock.now() + FIRST_S
        self._look_due = clock.now() + LOOK_S
        self._waiting: list[OnDone] = []
        self._over = asyncio.Event()
        self._over.set()

    @property
    def fault(self) -> bool:
        """Whether the map cannot be saved."""
        return bool(self.error)

    @property
    def refused(self) -> bool:
        """Whether a stored map was found that cannot be used, and none has been saved since."""
        return self._store is not None and self._store.refused and self.saves == 0

    @property
    def ready(self) -> bool:
        """Whether the estimator is loaded."""
        return self._state() is not None

    @property
    def map_id(self) -> int:
        """Identity of the map in use."""
        return self._map_id()

    def switched(self, map_id: int, start: Start) -> None:
        """Update after a switch to the stored map ``map_id``; its present content counts as saved."""
        self._start, self._map_of, self._anew = start, map_id, False
        if (state := self._state()) is not None:
            _, news, closures = self._revision(state)
            self._saved = map_id, news, closures

    def without_start(self) -> None:
        """Update when the run starts without the stored map, under a new identity: nothing is saved yet."""
        self._start, self._map_of = None, self._map_id()

    def loaded(self) -> None:
        """Mark the estimator as loaded: the first revision counts as saved, and the start trial begins."""
        state, self._proved_at = self._state(), self._clock.now() + PROOF_S
        if state is not None and self._start is not None:
            self._saved = self._revision(state)

    def ask(self, on_done: OnDone) -> None:
        """Save as soon as possible; ``on_done`` is called at the end, with the reason of a failure."""
        if reason := self._against():
            on_done(reason)
            return
        self._waiting.append(on_done)
        self._go_on()

    def _against(self) -> str:
        """Reason why a requested save has nothing to do; empty otherwise."""
        if self._store is None:
            return NO_FOLDER
        if self._about.localise:
            return FIXED
        state = self._state()
        if state is None or empty(state):
            return NO_MAP
        return ADRIFT if state.map.parts.unproved is not None and self._saved == self._revision(state) else DONE

    async def run(self) -> None:
        """Save on the schedule until cancelled."""
        while True:
            await asyncio.sleep(BEAT_S)
            if self._clock.now() >= self._proved_at:
                await self._proved()
            self._go_on()

    async def _proved(self) -> None:
        """Record that the run has outlived the trial period of its first map."""
        self._proved_at, self._lasted = math.inf, True
        if self._store is not None:
            with contextlib.suppress(RuntimeError):  # no thread is available: the next start has one attempt less
                await run_in_thread(self._store.lasted, "map")

    async def finish(self, in_order: bool = True) -> None:
        """Save what has changed since the last save, and wait at most :data:`STOP_S` for it.

        ``in_order``: the run was stopped on request. A run that a defect ends within the trial period saves nothing: a
        service that fails repeatedly would leave a map each time.
        """
        with contextlib.suppress(asyncio.TimeoutError):
            async with asyncio.timeout(STOP_S):
                if in_order and not self._lasted and self._store is not None:
                    with contextlib.suppress(RuntimeError):
                        await run_in_thread(self._store.trial.ended, "map")
                await self._over.wait()
                if in_order or self._lasted:
                    self._due, self._last = self._clock.now(), True
                    self._go_on()
                    await self._over.wait()
        if not self._over.is_set():
            log.error("the map could not be saved within %.0f s after shutdown began; the previous one remains", STOP_S)
        elif self._store is not None:
            self._store.close()

    def _go_on(self) -> None:
        """Start a save if one is due and none is in progress."""
        state, store = self._state(), self._store
        if store is None or self._about.localise or not self._over.is_set():
            return
        if store.trouble and not self._last and self._clock.now() >= self._look_due:
            self._look(store)
            return
        if state is None:
            return
        revision = self._revision(state)
        if self._map_id() != self._map_of:  # a new map is saved at once, so that the old one is not loaded again
            self._start, self._map_of, self._anew, self._due = None, self._map_id(), True, self._clock.now()
        news = self._anew or (revision != self._saved and not empty(state))
        if not (self._waiting or (news and self._clock.now() >= self._due)):
            return
        self._anew = False
        waiting, self._waiting = self._waiting, []
        end = partial(self._end, revision, waiting)
        self._busy(True)
        try:
            self._begin(store, state, end)
        except Exception as failure:  # no memory, no thread, or a defect: clients get the reason; retried
            log.exception("saving the map cannot begin")
            end(None, f"saving cannot begin: {failure!r}")

    def _busy(self, busy: bool) -> None:
        """Record whether a thread uses the folder."""
        self.busy_since = time.monotonic() if busy else None
        if busy:
            self._over.clear()
        else:
            self._over.set()

    def _look(self, store: Store) -> None:
        """Try again to lock the folder, in a thread, because a disk may hang."""
        self._look_due = self._clock.now() + LOOK_S
        loop, before = asyncio.get_running_loop(), store.trouble

        def work() -> None:
            store.claim()
            with contextlib.suppress(RuntimeError):  # the loop has closed: no client waits any more
                loop.call_soon_threadsafe(self._looked, store, before)

        self._busy(True)
        try:
            threading.Thread(target=work, name="lumiloop-map", daemon=True).start()
        except Exception:  # no memory, or no thread: the next attempt comes soon
            log.exception("the map folder cannot be checked")
            self._busy(False)

    def _looked(self, store: Store, before: str) -> None:
        """Handle the result of the locking attempt, in the loop's thread."""
        self._busy(False)
        if self.error == before:
            self.error = store.trouble
        if not store.trouble:
            log.info("maps can be stored in %s from now on", store.folder)
        self._go_on()

    def _begin(self, store: Store, state: State, end: End) -> None:
        """Collect the map and start a thread that saves it and calls ``end`` in this one."""
        begun = time.perf_counter()
        image = self._image(state)
        log.debug("the map was copied for saving in %.2f ms", 1e3 * (time.perf_counter() - begun))
        work = partial(self._work, store, image, asyncio.get_running_loop(), end)
        threading.Thread(target=work, name="lumiloop-map", daemon=True).start()

    def _revision(self, state: State) -> Revision:
        """Revision of the map, which changes when there is something new to save."""
        atlas = state.map.graph
        if (first := state.map.parts.unproved) is not None:
            return self._map_id(), first, -1
        return self._map_id(), state.map.next_key, atlas.closures

    def _image(self, state: State) -> MapImage:
        from estimator import Identity, image_of

        before = self._start.stored.meta if self._start is not None else None
        who = Identity(
            map_id=self._map_id(),
            name=before.name if before is not None else "",
            surveyed=before is not None and before.surveyed,
            survey=self._about.survey or (before.survey if before is not None else ""),
            session=1 + (before.session if before is not None else 0),
        )
        return image_of(state, who)

    def _work(self, store: Store, image: MapImage, loop: asyncio.AbstractEventLoop, end: End) -> None:
        """Pack, write and verify the map, in a thread of its own."""
        path, error = None, DONE
        try:
            path = store.save(self._packed(image), image.identity.map_id)
        except OSError as failure:
            error = f"{store.folder}: {said(failure)}"
        except BadMap as failure:
            error = f"{store.folder}: {failure}"
        except Exception as failure:  # a defect in the packing must not end saving for good, and is logged in full
            log.exception("the map cannot be encoded")
            error = f"the map cannot be encoded: {failure!r}"
        with contextlib.suppress(RuntimeError):  # the loop has closed: no client waits any more
            loop.call_soon_threadsafe(end, path, error)

    def _packed(self, image: MapImage) -> bytes:
        from daemon.maps.image import meta_of, packed

        meta = meta_of(image, self._clock.utc(), self._about.robot, release())
        return packed(image, meta, partial(time.sleep, BREATH_S))

    def _end(self, revision: Revision, waiting: list[OnDone], path: Path | None, error: str) -> None:
        """Handle the end of a save, in the loop's thread."""
        self._busy(False)
        self._due = self._clock.now() + (RETRY_S if error else EVERY_S)
        if path is not None:
            self._saved = revision
            self.saves += 1
            news = waiting or self.error or self.saves == 1 or self._last
            log.log(logging.INFO if news else logging.DEBUG, "map saved: %s", path)
        else:
            # retry even without a new revision: the fault ends only when a save succeeds
            self._anew |= self._saved is not None and (self._saved == revision or self._saved[0] != self._map_id())
        if error and not self.error:
            again = "" if self._last else "; the daemon tries again"
            log.info("the map cannot be saved (%s). The stored map remains%s", error, again)  # the fault is the warning
        self.error = error
        for on_done in waiting:
            on_done(error)
        if self._waiting:
            self._go_on()


def empty(state: State) -> bool:
    """Whether the map is empty: no keyframe, and no learned lamp gains."""
    learned = state.light is not None and bool(state.light.filter.gains)
    return not (state.map.keyframes or state.map.graph.submaps or learned)
