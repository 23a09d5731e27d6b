"""A stream with a robot on it, served from a thread as a daemon's process would."""

import asyncio
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from daemon.maps.tiles import MapTiles
from daemon.publish.stream.server import SIDE, StreamServer
from daemon.snapshot import CycleTiming, LightFix, LightLink, LightPicture, LinkUse, Snapshot, State, Trust
from tests.daemon.publish.stream.test_server import raw_scan

LINKS = (
    LightLink(5, 12, LinkUse.ACCEPTED, 1e-6, 0.01),
    LightLink(6, None, LinkUse.UNSURVEYED, 2e-7, None),
)
SNAPSHOT = Snapshot(
    7,
    1.0,
    1.25,
    1.7e9,
    State.TRACKING,
    3,
    pose=(1.0, 2.0, 3.0),
    odom=(0.5, 0.0, 1.0),
    covariance=(0.01, 0.0, 0.01, 0.0, 0.0, 0.001),
    velocity=(0.5, 0.0, 0.1),
    known=(True, True, True),
    map_id=0xABCD,
    light=LightPicture(LightFix.GOOD, 1, 0.9, (1.0, 2.0, 3.0), (0.01, 0.01, 0.01), links=LINKS),
    scan_rate=10.0,
    cycle_us=900,
    trust=Trust(horizontal_m=0.1, limit_m=0.3, laser=True, light=True),
    pulse=CycleTiming(cycle=(900, 1500, 2000), late=(50, 90, 120)),
)


def turn(server: StreamServer, number: int, place: tuple[float, float, float] | None = SNAPSHOT.pose) -> None:
    """What one cycle tells."""
    t = 1.0 + 0.025 * number
    moving = replace(
        SNAPSHOT, seq=number, pose=place, t_mono=t, t_sent=t + 0.01, t_utc=1.7e9 + t + 0.01, loop_counter=number // 20
    )
    assert SNAPSHOT.light is not None
    server.publish(replace(moving, light=replace(SNAPSHOT.light, t_mono=t)))
    server.on_scan(raw_scan(number))
    server.on_raw("lidar", "rx", t, b"99b")
    if number % 20 == 5:
        server.on_faults(t, [(104, "no valid scan", "check the cable", 0)] if number % 40 == 5 else [])
        server.on_statistics(lambda: {"t_mono": t, "cycles": number, "uptime": t, "memory_mb": 99.5})


def with_map(server: StreamServer) -> None:
    """One tile, with a wall along its left side."""
    cells = np.full((SIDE, SIDE), -20, np.int8)
    cells[:, 0] = 30
    server.tiles = MapTiles(lambda: None, server.on_tiles)
    server.tiles.tiles[0, -1] = 1, zlib.compress(cells.tobytes())


@contextmanager
def served(
    path: Path,
    each: Callable[[StreamServer, int], None] = turn,
    place: tuple[float, float, float] | None = None,
) -> Iterator[StreamServer]:
    """A robot that drives at 40 Hz, as long as the context lasts; ``place``: where it says it is."""
    if place is not None:
        each = partial(turn, place=place)
    server = StreamServer(path, "agv", lambda reason: (f"meaning {reason}", "remedy"))
    with_map(server)
    stop, ready = threading.Event(), threading.Event()

    async def body() -> None:
        serving = asyncio.ensure_future(server.run())
        number = 0
        while not stop.is_set():
            await asyncio.sleep(0.025)
            each(server, number)
            number += 1
            ready.set()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

    thread = threading.Thread(target=lambda: asyncio.run(body()))
    thread.start()
    try:
        assert ready.wait(5.0)
        yield server
    finally:
        stop.set()
        thread.join()
