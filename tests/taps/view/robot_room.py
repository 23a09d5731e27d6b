"""A page of a robot that is drawn by hand: a room with a glass wall, lamps, ten minutes of history, and no daemon."""

import asyncio
import contextlib
import math
import time
import zlib
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.publish.stream.messages import Loop, MapTiles, Scan
from daemon.snapshot import DimmedLamp, LightFix, LightLink, LightPicture, LinkUse, State, Trust
from taps.access_guard import Guard
from taps.view.page_hello import Scene
from tests.taps.view.house import TOKEN, House, serving, snapshot

WIDTH, DEPTH = 10.0, 8.0
"""Of the room, m; its corner is the origin of the map."""
GLASS: Final = (3.0, 5.0)
"""The east wall is glass between these y (m): the lidar sees the street behind it, 40 m away."""
STREET = 40.0
CELL, SIDE = 0.05, 128
BEFORE = 24_000
"""Snapshots before the page is opened: ten minutes."""
START_UTC: Final = time.time() - 700.0
LAMPS: Final = [(number, number % 7, 2.0 + 3.0 * (number % 3), 2.0 + 4.0 * (number % 2)) for number in range(71, 77)]
USES: Final = (LinkUse.ACCEPTED, LinkUse.ACCEPTED, LinkUse.OCCLUDED, LinkUse.REJECTED, LinkUse.RIM, LinkUse.ACCEPTED)
FAULTS: Final = [
    {"fault": 231, "meaning": "the computer is too slow", "remedy": "stop other programs: `top`", "cause": 0},
    {"fault": 102, "meaning": "scans are missing", "remedy": "look at the cable", "cause": 231},
    {"fault": 233, "meaning": "cycles are over budget", "remedy": "a faster computer", "cause": 102},
    {"fault": 171, "meaning": "lamp 74 is not where the survey has it", "remedy": "survey it again", "cause": 0},
]
"""The two in the middle follow from the first, one of them through the other."""


def pose_at(t: float) -> tuple[float, float, float]:
    """On an oval about the middle of the room."""
    turn = 0.2 * t
    return (
        WIDTH / 2 + 2.5 * math.cos(turn),
        DEPTH / 2 + 1.5 * math.sin(turn),
        math.atan2(1.5 * math.cos(turn), -2.5 * math.sin(turn)),
    )


def range_to_wall(x: float, y: float, bearing: float) -> float:
    """Of a beam from inside, m."""
    c, s = math.cos(bearing), math.sin(bearing)
    ahead = [(WIDTH - x) / c if c > 0 else -x / c if c < 0 else math.inf]
    ahead.append((DEPTH - y) / s if s > 0 else -y / s if s < 0 else math.inf)
    found = min(ahead)
    through = c > 0 and found == ahead[0] and GLASS[0] < y + found * s < GLASS[1]
    return (STREET - x) / c if through else found


def map_tiles() -> MapTiles:
    """What the daemon has mapped: the room, and a fan of street."""
    x = (np.arange(round(STREET / CELL) + 40) - 20) * CELL + CELL / 2
    y = (np.arange(round(DEPTH / CELL) + 40) - 20) * CELL + CELL / 2
    X, Y = np.meshgrid(x, y)
    inside = (X > 0) & (X < WIDTH) & (Y > 0) & (Y < DEPTH)
    street = (X >= WIDTH) & (X < STREET) & (np.abs(Y - 4.0) < 1.0 + 0.1 * (X - WIDTH))
    wall = ~inside & (X > -0.1) & (X < WIDTH + 0.1) & (Y > -0.1) & (Y < DEPTH + 0.1)
    wall &= ~((X > WIDTH) & (GLASS[0] < Y) & (GLASS[1] > Y))
    cells = np.where(wall, 20, np.where(inside | street, -16, 0)).astype(np.int8)
    cells[(X > STREET) & (np.abs(Y - 4.0) < 4.0)] = 20
    origin, tiles = -20, []
    for row in range(-1, 2):
        for column in range(-1, 8):
            tile = np.zeros((SIDE, SIDE), np.int8)
            left, low = column * SIDE - origin, row * SIDE - origin
            rows = slice(max(0, low), min(cells.shape[0], low + SIDE))
            columns = slice(max(0, left), min(cells.shape[1], left + SIDE))
            if rows.start < rows.stop and columns.start < columns.stop:
                tile[rows.start - low : rows.stop - low, columns.start - left : columns.stop - left] = cells[
                    rows, columns
                ]
                tiles.append((column, row, zlib.compress(tile.tobytes())))
    return MapTiles(map_id=7, resolution=CELL, side=SIDE, unit=0.1, version=1, more=False, tiles=tuple(tiles))


def scan_at(seq: int, t: float) -> Scan:
    """One scan of 541 beams from where the robot is."""
    x, y, yaw = pose_at(t)
    first, step = math.radians(-135.0), math.radians(0.5)
    ranges = np.array([range_to_wall(x, y, yaw + first + k * step) for k in range(541)], "<f4")
    return Scan(seq=seq, t_mono=t, bearing_first=first, bearing_step=step, ranges=ranges.tobytes())


def light_at(t: float) -> LightPicture:
    """Six lamps, some of which are not used, and one that is dimmed by PWM."""
    x, y, _ = pose_at(t)
    links = tuple(
        LightLink(code, lamp, use, 2e-6 / (1.0 + math.hypot(lx - x, ly - y)) ** 2, 0.02 * (k - 2))
        for k, ((lamp, code, lx, ly), use) in enumerate(zip(LAMPS, USES, strict=True))
    )
    dimmed = (DimmedLamp(15_000.0, 4.96e-6, 7222.2),)
    return LightPicture(LightFix.GOOD, 3, t, pose_at(t), (0.01, 0.02, 0.03), 0.1, 3.0, 7, 0, links[:5], dimmed)


def told_at(seq: int, **other: Any) -> Any:
    """The snapshot of a cycle; ``seq`` counts 25 ms."""
    t = 100.0 + 0.025 * seq
    trust = Trust(horizontal_m=0.08 + 0.03 * math.sin(0.1 * t), limit_m=0.5, gap=1.0, laser=True, light=True)
    state = State.MAPPING if t < 160.0 else State.DEGRADED if 400.0 < t < 440.0 else State.TRACKING
    told = {"pose": pose_at(t), "light": light_at(t), "trust": trust, "state": state, "cycle_us": 1500 + seq % 700}
    made = snapshot(seq, **{**told, "velocity": (0.4, 0.0, 0.2), **other})
    return replace(made, t_utc=START_UTC + t + 0.002)


@contextlib.asynccontextmanager
async def showing(folder: Path, scene: Scene | None = None) -> AsyncIterator[House]:
    """A page that shows the room, now and the ten minutes before; who has the token may order."""
    scene = scene or Scene("agv-7", lamps=LAMPS, budget_ms=5.0, alert_m=0.5)
    async with serving(folder, guard=Guard("127.0.0.1", TOKEN, True), scene=scene) as house:
        house.stream.publish(told_at(0))
        await asyncio.sleep(0.05)
        for seq in range(20, BEFORE, 20):
            house.stream.publish(told_at(seq))
            if seq % 400 == 0:
                await asyncio.sleep(0)
        beating = asyncio.create_task(_beat(house))
        try:
            yield house
        finally:
            beating.cancel()
            await asyncio.gather(beating, return_exceptions=True)


async def _beat(house: House) -> None:
    seq, hub = BEFORE, house.view.hub
    loop = Loop(
        t_mono=650.0, counter=1, keyframe_new=120, keyframe_old=3, reason=1, residual=0.02,
        at_new=pose_at(600.0), at_old=pose_at(592.0),
    )  # fmt: skip
    hub.distribute(loop)
    hub.distribute(map_tiles())
    while True:
        house.stream.publish(told_at(seq))
        hub.distribute(scan_at(seq, 100.0 + 0.025 * seq))
        seq += 2
        await asyncio.sleep(0.05)
