"""Periodic messages of the local stream, once a second: faults, statistics, tiles of the map."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

from daemon.health.causes import cause_of
from daemon.health.faults import FAULTS, Fault
from daemon.maps.tiles import MapTiles
from daemon.publish.stream.server import FaultInWords, StreamServer
from daemon.runtime.cycle_facts import CycleFacts
from daemon.runtime.vitals import process_age_s, resident_mb

if TYPE_CHECKING:  # the warm-up loads the estimator in a thread
    from estimator import State

BEAT_S: Final = 1.0


class StreamBeat:
    """Supervised component that sends the periodic messages.

    Args:
        facts: about the cycle. state: of the estimator, None before it is loaded. faults: present ones.
    """

    def __init__(
        self,
        server: StreamServer,
        facts: Callable[[], CycleFacts],
        state: Callable[[], State | None],
        faults: Callable[[], tuple[Fault, ...]],
    ) -> None:
        self._server, self._facts, self._faults = server, facts, faults
        server.place = partial(place_of, state)
        self.tiles = server.tiles = MapTiles(state, server.on_tiles)

    async def run(self) -> None:
        """Send once a second until cancelled."""
        loop = asyncio.get_running_loop()
        try:
            while True:
                await asyncio.sleep(BEAT_S)
                self.beat(loop)
        finally:
            self.tiles.close()

    def beat(self, loop: asyncio.AbstractEventLoop) -> None:
        """Send one set of periodic messages."""
        server, facts = self._server, self._facts()
        server.on_faults(facts.t_mono, in_words(self._faults()))
        server.on_statistics(lambda: figures(facts))
        if server.wanted("map"):
            self.tiles.follow(loop)
        else:
            self.tiles.forget()


def in_words(faults: tuple[Fault, ...]) -> list[FaultInWords]:
    """Number, meaning and remedy of each fault, and the fault it follows from (0: none)."""
    return [(int(fault), *FAULTS[fault], cause_of(fault, faults)) for fault in faults]


def place_of(state: Callable[[], State | None], keyframe: int) -> tuple[float, float, float] | None:
    """Pose of a keyframe in the map with all corrections (m, m, rad); None where it is not stored any more."""
    now = state()
    frame = None if now is None else now.map.keyframes.get(keyframe)
    if frame is None:
        return None
    x, y, yaw = frame.T_map_keyframe.tolist()
    return x, y, yaw


def figures(facts: CycleFacts) -> dict[str, object]:
    """Counters since the start, times in s unless stated otherwise."""
    lidar, photodiode = facts.lidar, facts.photodiode
    return {
        "t_mono": facts.t_mono,
        "uptime": process_age_s(),
        "memory_mb": resident_mb(),
        "cycles": facts.cycles,
        "overruns": facts.overruns,
        "cycle_us": facts.cycle_us,
        "jobs_failed": facts.jobs_failed,
        "scan_period": facts.period,
        "scans": lidar.scans,
        "scans_missed": lidar.missed,
        "scans_invalid": lidar.invalid,
        "scans_dropped": facts.scans_dropped,
        "resyncs": lidar.resyncs,
        "reconnects": lidar.reconnects,
        "blocks": None if photodiode is None else photodiode.blocks,
        "blocks_lost": None if photodiode is None else photodiode.blocks_lost,
        "odometry_jumps": facts.odometry_jumps,
    }
