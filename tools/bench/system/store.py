"""The stored map: how long it takes to be gathered in a cycle, packed, written, checked and loaded; how large it is.

A robot drives once through the simulated office floor (1536 m2, 1081 beams); its map is then laid side by side until it
covers 2000 m2 and more, each copy with keys of its own, as floors of a building would be. The lateness of a loop at
100 Hz is measured with and without a save going on in the keeper's thread.
"""

import asyncio
import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from daemon.maps.autosave import BREATH_S
from daemon.maps.image import image_from, meta_of, packed
from daemon.maps.schema import read
from daemon.maps.store import Store
from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Submap
from estimator.mapping.map_snapshot import Identity, MapImage, finished
from estimator.measurements import UNLIMITED, Answer, Array, Beam, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import State, new_state, step
from estimator.stored_map import image_of, restored
from tools.ci.figures import Figure, bounded
from tools.sim.building.buildings import building
from tools.sim.building.office import LENGTH
from tools.sim.scene import Scenario, SimulatedScene, sweep_of

COMMAND: Final = "python -m tools.bench store"
AREA_M2: Final = 1536.0
WANTED_M2: Final = 2000.0
SCANS_HZ: Final = 4.0
TICK_S: Final = 0.01
BEGIN_S: Final = 10.0


def run() -> list[Figure]:
    """The figures."""
    state = driven()
    one = finished(image_of(state, Identity(7, "office")))
    image = side_by_side(one, math.ceil(WANTED_M2 / AREA_M2))
    running = restored(image)
    running.map.parts.detached = None
    content = packed(image, meta_of(image, 0.0, "bench", "0"))
    frames = sum(1 for _ in image.keyframes())
    many = side_by_side(one, 8)
    later = restored(many)
    later.map.parts.detached = None
    area = f"{math.ceil(WANTED_M2 / AREA_M2) * AREA_M2:.0f} m2"
    figures = [
        Figure("submaps", len(image.submaps), "", command=COMMAND),
        Figure("keyframes", frames, "", command=COMMAND),
        Figure(f"file, {area}", len(content) / 1e6, "MB", command=COMMAND),
        bounded("gathered in the cycle", 1e3 * least(lambda: image_of(running)), "ms", "<= 1", COMMAND),
        Figure(
            f"gathered with {len(many.submaps)} submaps", 1e3 * least(lambda: image_of(later)), "ms", "", None, COMMAND
        ),
        Figure("packed", least(lambda: packed(image, meta_of(image, 0.0, "bench", "0"))), "s", command=COMMAND),
        Figure("written and verified", writing(content), "s", command=COMMAND),
        bounded(f"loaded, {area}", least(lambda: load(content)), "s", "<= 1", COMMAND),
    ]
    return figures + lateness(image)


def driven() -> State:
    """The estimator after one tour of the office floor."""
    scene = SimulatedScene(Scenario(lidar="UTM-30LX"), building("office_floor"))
    state = new_state()
    seconds = scene.drive.lap_s
    for records in recorded(scene, seconds):
        jobs = step(state, records, UNLIMITED).jobs
        while jobs:
            jobs = step(state, [Answer(0.0, job.job_id, job.run()) for job in jobs], UNLIMITED).jobs
    return state


def recorded(scene: SimulatedScene, seconds: float) -> Iterator[list[Record]]:
    """Scans, and the wheels' way between them."""
    sweep, model = sweep_of(scene.model), scene.model
    kept = slice(model.amin, model.amax + 1)
    before: tuple[float, Array] | None = None
    for seq in range(int(seconds * SCANS_HZ)):
        t = BEGIN_S + seq / SCANS_HZ
        seen = scene.scan(t).ranges_mm[kept]
        begin = t + sweep.first_s
        end = begin + sweep.sweep_s
        kind = np.where((seen >= model.dmin) & (seen <= model.dmax), np.uint8(Beam.HIT), np.uint8(Beam.NONE))
        now = scene.odometry_after(end)
        assert now is not None
        records: list[Record] = []
        if before is not None:
            records.append(Odometry(before[0], now[0], se2.between(before[1], now[1])))
        before = now
        yield [*records, Scan(begin, end, seq, np.array(scene.mount), sweep.bearing_rad, 1e-3 * seen, kind, 0.01)]


def side_by_side(image: MapImage, copies: int) -> MapImage:
    """The same map several times, each a building's length beside the one before and joined with it."""
    step_key = image.submaps[-1].key
    step_frame = max(hung.frame.key for hung in image.keyframes())
    pieces, frames, joins = [], [], []
    for n in range(copies):
        moved = np.array((n * LENGTH, 0.0, 0.0))
        stands = {}
        for piece in image.submaps:
            T_map = se2.compose(moved, piece.T_map_submap)
            other = piece._replace(key=piece.key + n * step_key, first=piece.first + n * step_frame, T_map_submap=T_map)
            pieces.append(other)
            stands[piece.key] = Submap(*other)
        for hung in image.keyframes():
            stand = stands[hung.submap]
            T_odom = se2.compose(stand.T_odom_submap, hung.T_submap_keyframe)
            key = hung.frame.key + n * step_frame
            frames.append(replace(hung.frame, key=key, submap=stand, T_odom_keyframe=T_odom))
        joins.append(image.constraints.between + n * step_key)
        if n:
            joins.append(np.array(((image.submaps[-1].key + (n - 1) * step_key, image.submaps[0].key + n * step_key),)))
    between = np.concatenate(joins)
    rows = np.resize(np.arange(len(image.constraints.loop)), len(between))
    same = image.constraints
    joined = Constraints(between, same.T[rows], same.information[rows], same.loop[rows])
    return replace(image, submaps=tuple(pieces), frames=tuple(frames), constraints=joined, hung={}, unsettled=())


def load(content: bytes) -> State:
    """From the bytes to a state that can be stepped."""
    return restored(image_from(read(content)))


def least(work: Callable[[], object], times: int = 5) -> float:
    """Seconds of the quickest of some: other programs run beside."""
    took = []
    for _ in range(times):
        begun = time.perf_counter()
        work()
        took.append(time.perf_counter() - begun)
    return min(took)


def writing(content: bytes) -> float:
    """Seconds of a save that is packed already."""
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        store = Store(Path(folder))
        try:
            return least(lambda: store.save(content, 7))
        finally:
            store.close()


def lateness(image: MapImage) -> list[Figure]:
    """How late a loop's ticks come, idle and during saves."""
    idle = asyncio.run(ticks(None))
    work = partial(packed, image, meta_of(image, 0.0, "bench", "0"), partial(time.sleep, BREATH_S))
    begun = time.perf_counter()
    work()
    took = time.perf_counter() - begun
    busy = asyncio.run(ticks(work))
    p = (50.0, 99.0)
    rows = [("idle", np.percentile(idle, p)), ("during a save", np.percentile(busy, p))]
    figures = [
        Figure(f"loop late, {when}, p{q:.0f}", 1e3 * v, "ms", "", None, COMMAND)
        for when, vs in rows
        for q, v in zip(p, vs, strict=True)
    ]
    return [Figure("packed in the keeper's thread", took, "s", command=COMMAND), *figures]


async def ticks(work: Callable[[], object] | None, count: int = 500) -> list[float]:
    """Lateness of ``count`` ticks, seconds, with ``work`` going on in a thread again and again."""
    over = threading.Event()

    def again() -> None:
        while work is not None and not over.is_set():
            work()

    thread = threading.Thread(target=again, daemon=True)
    thread.start()
    late, loop = [], asyncio.get_running_loop()
    due = loop.time()
    for _ in range(count):
        due = max(due + TICK_S, loop.time())
        await asyncio.sleep(due - loop.time())
        late.append(loop.time() - due)
    over.set()
    await asyncio.to_thread(thread.join)
    return late
