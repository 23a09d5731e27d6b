"""SWITCH_MAP: the robot goes on in another stored map, while the daemon runs.

The map in use is saved, the other one is read and made into a state in a thread, and between two cycles the running
state takes that one's map over. What the robot knows of itself stays: ``T_odom_base`` does not jump, odometry and
velocity go on; where it is in the new map is looked for, as after a start in it. If anything on the way fails, nothing
has changed.
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

if TYPE_CHECKING:  # the estimator is loaded in a thread, by the warm-up
    from estimator import State

log = logging.getLogger(__name__)

NOTHING_TO_SAVE: Final = (DONE, NO_MAP, FIXED, ADRIFT)

BUSY: Final = "another map is just being loaded"
IN_USE: Final = "that map is in use"
NO_FOLDER: Final = "maps are not kept: `map.folder` is none"
NOT_LOADED: Final = "the estimator is still being loaded"
NOTHING_COMES: Final = "nothing arrives from lidar, odometry or photodiode, so no cycle can take the map over"
TAKEN_S: Final = 10.0
"""A cycle that has something to work with takes the map within a scan; without any it is given up after this long."""


@dataclass(frozen=True, slots=True, eq=False)
class Switch:
    """A map that is ready to be gone on in.

    Attributes:
        map_id, sha256: its identity, and of its content. donor: a state that has just been made with it. start: the
            stored map.
    """

    map_id: int
    sha256: str
    donor: State
    start: Start


def take_over(state: State, donor: State) -> None:
    """The running state goes on in the donor's map, detached in it; the donor is not to be used any more.

    Answers to what was asked about the old map will mean nothing: job numbers go on counting.
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
    """Where the maps are, and how they become states.

    Attributes:
        store: of maps; None: they are not kept. judge: whether a stored map fits what is configured of lights.
        make: a state made with a stored map. keep: takes digest and content for a recording, and may raise OSError;
            None: nothing is recorded. Both are called in a thread.
    """

    store: Store | None
    judge: Judge
    make: Callable[[Start], State]
    keep: Callable[[str, bytes], None] | None = None


class MapSwitch:
    """Carries out one switch after the other.

    Args:
        autosaver: saves the map in use.
        put: hands a switch to the cycle; its second argument is called once the cycle has taken it. None takes back
            what has been handed over and not been taken.
    """

    def __init__(
        self, maps: Maps, autosaver: MapAutosaver, put: Callable[[Switch | None, Callable[[], None]], None]
    ) -> None:
        self._maps, self._autosaver, self._put = maps, autosaver, put
        self._task: asyncio.Task[None] | None = None

    def ask(self, map_id: int, on_done: OnDone, patient: bool = False) -> None:
        """Go on in a stored map; ``on_done``: empty, or why that came to nothing.

        ``patient``: wait for a cycle that takes it for as long as it may be; nobody waits for an answer.
        """
        if self._task is not None and not self._task.done():
            on_done(BUSY)
            return
        self._task = asyncio.get_running_loop().create_task(self._switch(map_id, on_done, patient), name="map switch")

    async def _switch(self, map_id: int, on_done: OnDone, patient: bool) -> None:
        try:
            reason = await self._carried_out(map_id, patient)
        except Exception as error:  # a defect must not leave the client waiting, and is told in full
            log.exception("the map cannot be switched")
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
            there = {one.map_id for one in await run_in_thread(store.generations, "switch") if one.map_id >= 0}
        except OSError as error:
            return f"{store.folder}: {said(error)}"
        if map_id not in there:
            named = ", ".join(f"{one:08x}" for one in sorted(there)) or "none"
            return f"there is no map {map_id:08x} in {store.folder}; there are: {named}"
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
        log.info("map %08x is in use; the robot is looked for in it", map_id)
        return DONE

    async def _saved(self) -> str:
        """The end of a save of the map in use."""
        ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._autosaver.ask(lambda reason: None if ended.done() else ended.set_result(reason))
        return await ended

    def _load(self, store: Store, map_id: int) -> Switch:
        """The stored map, made into a state; in a thread of its own."""
        start = store.load_map(map_id, self._maps.judge)
        sha256 = hashlib.sha256(start.content).hexdigest()
        donor = self._maps.make(start)
        if self._maps.keep is not None:
            self._maps.keep(sha256, start.content)
        return Switch(map_id, sha256, donor, start)
