"""Map switch (SWITCH_MAP): change to another stored map while the daemon runs.

The map in use is saved. A thread reads the other one and builds an estimator state with it. Between two cycles the
running state adopts that map.
The robot's own motion continues: ``T_odom_base`` does not jump, odometry and velocity go on. Relocalisation finds the
pose in the new map, as after a start in it. If any step fails, nothing has changed.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from daemon.maps.autosave import ADRIFT, DONE, FIXED, NO_MAP, MapAutosaver
from daemon.maps.container import BadMap
from daemon.maps.generations import said
from daemon.maps.store import Judge, Start, Store
from daemon.system.callbacks import OnDone
from hal.blocking_calls import run_in_thread

if TYPE_CHECKING:  # the warm-up loads the estimator in a thread
    from estimator import State

log = logging.getLogger(__name__)

NOTHING_TO_SAVE: Final = (DONE, NO_MAP, FIXED, ADRIFT)

BUSY: Final = "another map is being loaded"
IN_USE: Final = "that map is in use"
NO_FOLDER: Final = "maps are not stored, because `map.folder` is none"
NOT_LOADED: Final = "the estimator is still being loaded"
NOTHING_COMES: Final = "no data arrive from lidar, odometry or photodiode, so no cycle can load the map"
TAKEN_S: Final = 10.0
"""Time limit in s: a cycle with records adopts the map within a scan; without one the switch is abandoned."""


@dataclass(frozen=True, slots=True, eq=False)
class Switch:
    """A loaded map that is ready for the switch.

    Attributes:
        map_id, sha256: its identity, and digest of its content. donor: a new state with this map. start: the stored
            map.
    """

    map_id: int
    sha256: str
    donor: State
    start: Start


def take_over(state: State, donor: State) -> None:
    """Move the donor's map, still detached, into the running state; the donor must not be used afterwards.

    Results of jobs on the old map are ignored, because job numbers continue.
    """
    from estimator import forget_map, se2

    forget_map(state)
    donor.map.graph.jobs, donor.map.graph.closures = state.jobs, state.map.graph.closures
    for name in ("graph", "keyframes", "places", "live", "next_key"):
        setattr(state.map, name, getattr(donor.map, name))
    for name in ("search", "unaligned", "T_left", "P_left"):
        setattr(state.relocalisation, name, getattr(donor.relocalisation, name))
    state.light, state.pose.alignment = donor.light, donor.pose.alignment
    state.matching.noise_m, state.matching.unheld_s = donor.matching.noise_m, 0.0
    state.pose.history.forget()
    state.pose.T_map_odom = se2.compose(donor.pose.T_map_odom, se2.inverse(state.motion.T_odom_base))
    state.map.T_map_start = state.pose.here(state.motion.T_odom_base)
    state.pose.jumps += 1


@dataclass(frozen=True, slots=True)
class Maps:
    """Source of stored maps and of estimator states made with them.

    Attributes:
        store: of maps; None: maps are not stored. judge: check of a stored map against the configured light setup.
        make: builds a state with a stored map. keep: stores digest and content in a recording, and may raise OSError;
            None: nothing is recorded. Both are called in a thread.
    """

    store: Store | None
    judge: Judge
    make: Callable[[Start], State]
    keep: Callable[[str, bytes], None] | None = None


def _identities(store: Store) -> set[int]:
    """Maps of the folder."""
    return {found for one in store.generations() if (found := store.identity(one)) >= 0}


class MapSwitch:
    """Carries out switches, one at a time.

    Args:
        autosaver: saves the map in use.
        put: hands a switch to the cycle; its second argument is called once the cycle has adopted it. None withdraws a
            switch that has not been adopted.
    """

    def __init__(
        self, maps: Maps, autosaver: MapAutosaver, put: Callable[[Switch | None, Callable[[], None]], None]
    ) -> None:
        self._maps, self._autosaver, self._put = maps, autosaver, put
        self._task: asyncio.Task[None] | None = None

    def ask(self, map_id: int, on_done: OnDone, patient: bool = False) -> None:
        """Switch to a stored map; ``on_done`` receives an empty text, or the reason of the failure.

        ``patient``: wait for the cycle without a time limit, because no client waits for the result.
        """
        if self._task is not None and not self._task.done():
            on_done(BUSY)
            return
        self._task = asyncio.get_running_loop().create_task(self._switch(map_id, on_done, patient), name="map switch")

    async def _switch(self, map_id: int, on_done: OnDone, patient: bool) -> None:
        try:
            reason = await self._carried_out(map_id, patient)
        except Exception as error:  # a defect must not leave the client waiting, and is logged in full
            log.exception("switching the map has failed")
            reason = repr(error)
        on_done(reason)

    async def _carried_out(self, map_id: int, patient: bool) -> str:
        store = self._maps.store
        if store is None:
            return NO_FOLDER
        if not self._autosaver.ready:
            return NOT_LOADED
        if map_id == self._autosaver.map_id:
            return IN_USE
        try:
            there = await run_in_thread(partial(_identities, store), "switch")
        except OSError as error:
            return f"{store.folder}: {said(error)}"
        if map_id not in there:
            named = ", ".join(f"{one:08x}" for one in sorted(there)) or "none"
            return f"no map {map_id:08x} in {store.folder} (copy its file there); available maps: {named}"
        if (reason := await self._saved()) not in NOTHING_TO_SAVE:
            return f"the map in use cannot be saved: {reason}"
        try:
            switch = await run_in_thread(partial(self._load, store, map_id), "switch")
        except (BadMap, OSError) as error:
            return f"map {map_id:08x} cannot be used: {said(error) if isinstance(error, OSError) else error}"
        taken = asyncio.Event()
        self._put(switch, taken.set)
        try:
            async with asyncio.timeout(None if patient else TAKEN_S):
                await taken.wait()
        except TimeoutError:
            if not taken.is_set():
                self._put(None, taken.set)
                return NOTHING_COMES
        log.info("map %08x is in use; the daemon searches for the pose in it", map_id)
        return DONE

    async def _saved(self) -> str:
        """Save the map in use and return the error, empty on success."""
        ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._autosaver.ask(lambda reason: None if ended.done() else ended.set_result(reason))
        return await ended

    def _load(self, store: Store, map_id: int) -> Switch:
        """Build a state with the stored map, in a thread of its own."""
        start = store.load_map(map_id, self._maps.judge)
        sha256 = hashlib.sha256(start.content).hexdigest()
        donor = self._maps.make(start)
        if self._maps.keep is not None:
            self._maps.keep(sha256, start.content)
        return Switch(map_id, sha256, donor, start)
