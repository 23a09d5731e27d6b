"""Live occupancy grid for display: tiles that follow the submaps, composed again only where a submap changes.

The background worker does the work, a few patches and tiles at a time (:func:`advance`). A cycle applies the result
(:meth:`LiveGrid.take`). A display requests the tiles that have changed since its own version. The final map of a replay
and the image of a map file use the same code at once (:func:`at_once`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from estimator.job_queue import DRAW, job_function
from estimator.mapping.grid_patches import SIDE, UNIT, Cells, Patch, Seen, Tile, compose, render
from estimator.mapping.keyframe import Keyframe, Submap, hanging
from estimator.mapping.occupancy_grid import Grid, blank
from estimator.mapping.submap_graph import SubmapGraph
from estimator.numerics import se2
from estimator.numerics.arrays import Array

RENDERS, TILES = 2, 4
"""Most patches rendered, and tiles composed, in one job: some 20 ms."""

MOVED: Final = 0.3
"""Displacement of a patch's farthest corner, in cells, above which its tiles are composed again."""

EVERY: Final = 4
"""Keyframes after which the submap under construction is rendered again."""

SPENT: Final = 0.05
"""Smallest share of a removed submap's patch that must still count, or the patch is removed, too."""


class Drawn(NamedTuple):
    """A patch in the tiles: its pose, the tiles, and the amount that counts in each."""

    patch: Patch
    T_map_submap: Array
    tiles: frozenset[Tile]
    used: dict[Tile, int]


class Place(NamedTuple):
    """Pose of a submap: in the map, or in another one that has replaced it in the graph."""

    T_map_hub: Array
    T_hub_submap: Array | None

    def now(self) -> Array:
        """T_map_submap."""
        return self.T_map_hub if self.T_hub_submap is None else se2.compose(self.T_map_hub, self.T_hub_submap)


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Input of a job, fixed when it is queued.

    Attributes:
        resolution: m per cell.
        drawn: patches in the tiles.
        places: poses of all submaps that have a patch or get one.
        fresh: keyframes of those to be rendered.
        more: whether others wait for rendering, too.
        spare: keys of submaps that are out of the graph.
        stale: tiles waiting to be composed.
    """

    resolution: float
    drawn: dict[int, Drawn]
    places: dict[int, Place]
    fresh: dict[int, tuple[Seen, ...]]
    more: bool
    spare: frozenset[int]
    stale: frozenset[Tile]


@dataclass(frozen=True, slots=True, eq=False)
class Progress:
    """Result of a job: its task, patches rendered or moved, tiles composed, tiles still stale, keys removed."""

    task: Task
    drawn: dict[int, Drawn]
    tiles: dict[Tile, Cells]
    stale: frozenset[Tile]
    gone: tuple[int, ...]


@dataclass(slots=True, eq=False)
class LiveGrid:
    """Occupancy grid that is kept up to date.

    Attributes:
        resolution: m per cell.
        version: counts changes.
        tiles: cells, and the version of their last change.
        submaps, drawn: by key, those whose patch is in the tiles.
        fresh: keyframes of those to be rendered.
        stale: tiles to be composed again.
        due: whether submaps may have moved.
        rendered, composed: numbers of patches and tiles.
    """

    resolution: float
    version: int = 0
    tiles: dict[Tile, tuple[int, Cells]] = field(default_factory=dict)
    submaps: dict[int, Submap] = field(default_factory=dict)
    drawn: dict[int, Drawn] = field(default_factory=dict)
    fresh: dict[int, tuple[Seen, ...]] = field(default_factory=dict)
    stale: frozenset[Tile] = frozenset()
    due: bool = False
    rendered: int = 0
    composed: int = 0

    def laid(self, submap: Submap, frames: Sequence[Keyframe]) -> None:
        """Add a submap with these keyframes, or render it again with more of them."""
        self.submaps[submap.key] = submap
        self.due = True
        self.fresh[submap.key] = tuple((se2.between(submap.T_odom_submap, f.T_odom_lidar), f) for f in frames)

    def task(self, detached: float = math.inf) -> Task:
        """The next job's input, without submaps from key ``detached`` on; the job itself finds what has moved."""
        ready = sorted(key for key in self.fresh if key < detached)
        fresh = {key: self.fresh[key] for key in ready[:RENDERS]}
        self.due = False
        shown = self.drawn.keys() | fresh.keys()
        places = {key: place_of(self.submaps[key]) for key in sorted(shown)}
        spare = frozenset(key for key in shown if self.submaps[key].into is not None)
        return Task(self.resolution, dict(self.drawn), places, fresh, len(ready) > RENDERS, spare, self.stale)

    def take(self, done: Progress) -> None:
        """Apply the result of a job."""
        self.drawn.update(done.drawn)
        for key, frames in done.task.fresh.items():
            if self.fresh.get(key) is frames:  # it has got no keyframe meanwhile
                del self.fresh[key]
        for key in done.gone:
            if key not in self.fresh:
                del self.drawn[key], self.submaps[key]
        self.stale = done.stale
        self.rendered += len(done.task.fresh)
        self.composed += len(done.tiles)
        changed = {tile: cells for tile, cells in done.tiles.items() if self.differs(tile, cells)}
        self.version += bool(changed)
        self.tiles.update((tile, (self.version, cells)) for tile, cells in changed.items())

    def differs(self, tile: Tile, cells: Cells) -> bool:
        """Whether a tile's cells differ from those published."""
        shown = self.tiles.get(tile)
        return bool(cells.any()) if shown is None else not np.array_equal(shown[1], cells)

    def busy(self, detached: float = math.inf) -> bool:
        """Whether there is work, or may be because submaps have moved; arguments as of :meth:`task`."""
        return bool(self.stale) or self.due or any(key < detached for key in self.fresh)

    def clear(self) -> None:
        """Clear the map; all published tiles change to empty ones."""
        self.version += bool(self.tiles)
        empty = np.zeros((SIDE, SIDE), np.int8)
        self.tiles = dict.fromkeys(self.tiles, (self.version, empty))
        self.submaps, self.drawn, self.fresh, self.stale = {}, {}, {}, frozenset()
        self.due = False

    def changed(self, since: int) -> tuple[int, dict[Tile, Cells]]:
        """The present version, and the tiles that have changed after version ``since``; 0: all of them."""
        return self.version, {tile: cells for tile, (version, cells) in self.tiles.items() if version > since}

    def grid(self) -> Grid:
        """All tiles as one grid, without unknown edges.

        Raises:
            ValueError: it would have too many cells.
        """
        known = [(tile, cells) for tile, (_, cells) in self.tiles.items() if cells.any()]
        if not known:
            return Grid(np.zeros(2), self.resolution, np.zeros((0, 0), np.float32))
        at = np.array([tile for tile, _ in known])
        low, high = at.min(axis=0), at.max(axis=0) + 1
        wide, tall = ((high - low) * SIDE).tolist()
        whole = blank(tall, wide, self.resolution)
        for (column, row), cells in known:
            i, j = (column - low[0]) * SIDE, (row - low[1]) * SIDE
            whole[j : j + SIDE, i : i + SIDE] = UNIT * cells
        rows, columns = np.flatnonzero(whole.any(axis=1)), np.flatnonzero(whole.any(axis=0))
        part = whole[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        origin = (low * SIDE + (columns[0], rows[0])) * self.resolution
        return Grid(origin, self.resolution, np.ascontiguousarray(part))


def follow(live: LiveGrid | None, graph: SubmapGraph, before: Submap | None, frames: Sequence[Keyframe]) -> None:
    """Update after a new keyframe; ``before`` was the newest submap before it, with these keyframes."""
    newest = graph.newest
    if live is None or newest is None:
        return
    if newest is not before:
        if newest.key == graph.parts.detached:  # what was detached before was never attached
            live.fresh = {key: seen for key, seen in live.fresh.items() if key < newest.key}
        if before is not None:
            live.laid(before, frames)
    if len(graph.frames) % EVERY == 1:
        live.laid(newest, graph.frames)
    live.due = True
    go_on(live, graph)


def begin(live: LiveGrid | None, keyframes: Iterable[Keyframe]) -> None:
    """Add the submaps of a restored map."""
    if live is not None:
        for submap, frames in hanging(keyframes):
            live.laid(submap, frames)


def redraw(live: LiveGrid | None, graph: SubmapGraph, keyframes: Iterable[Keyframe]) -> None:
    """Restart with the contents of another map; the result of a running job is dropped."""
    if live is not None:
        graph.jobs.cancel(live)
        live.clear()
        begin(live, keyframes)


def forget(live: LiveGrid | None, graph: SubmapGraph, first: int) -> None:
    """Remove the submaps from key ``first`` on; the result of a running job is dropped."""
    if live is None:
        return
    graph.jobs.cancel(live)
    for key in [key for key in live.drawn if key >= first]:
        live.stale |= live.drawn.pop(key).tiles
    live.submaps = {key: submap for key, submap in live.submaps.items() if key < first}
    live.fresh = {key: seen for key, seen in live.fresh.items() if key < first}


def go_on(live: LiveGrid | None, graph: SubmapGraph) -> None:
    """Queue the next job, if there is work and none is running."""
    detached = math.inf if graph.parts.detached is None else graph.parts.detached
    if live is None or not live.busy(detached) or graph.jobs.busy(live):
        return
    graph.jobs.ask(DRAW, partial(advance, live.task(detached)), partial(take_drawn, live), owner=live)


@job_function
def take_drawn(live: LiveGrid, payload: object) -> None:
    """Apply the result of a job."""
    assert isinstance(payload, Progress)
    live.take(payload)


def place_of(submap: Submap) -> Place:
    """Present pose of a submap, without computation: pose arrays are replaced, never changed."""
    if submap.into is None:
        return Place(submap.T_map_submap, None)
    hub, T_hub_submap = submap.into
    if hub.into is None:
        return Place(hub.T_map_submap, T_hub_submap)
    return Place(submap.place(), None)


@job_function
def advance(task: Task) -> Progress:
    """Render, find what has moved, compose some of the stale tiles; changes nothing but its result."""
    fresh = {}
    stale = set(task.stale)
    for key, place in task.places.items():
        T, shown = place.now(), task.drawn.get(key)
        if key in task.fresh:
            patch = render(task.fresh[key], T, task.resolution)
        elif shown is not None and shift(shown, T) > MOVED * task.resolution:
            patch = shown.patch
        else:
            continue
        touched = patch.touches(T, task.resolution)
        fresh[key] = Drawn(patch, T, touched, {})
        stale |= touched | (frozenset() if shown is None else shown.tiles)
    return composed(task, fresh, stale)


def composed(task: Task, fresh: dict[int, Drawn], stale: set[Tile]) -> Progress:
    """Compose some of the stale tiles, with the patches at their new poses."""
    lying = {**task.drawn, **fresh}
    now = [] if task.more else sorted(stale)[:TILES]
    order = [(key, one.patch, one.T_map_submap, one.tiles) for key, one in sorted(lying.items(), reverse=True)]
    tiles, used = compose(now, order, task.resolution)
    for (key, tile), count in used.items():
        one = lying[key]
        lying[key] = fresh[key] = one._replace(used={**one.used, tile: count})
    rest = frozenset(stale.difference(now))
    gone = tuple(key for key in sorted(task.spare) if spent(lying[key], rest))
    return Progress(task, fresh, tiles, rest, gone)


def shift(shown: Drawn, T_map_submap: Array) -> float:
    """Largest displacement (m) of a patch from its pose in the tiles."""
    if T_map_submap is shown.T_map_submap:
        return 0.0
    x, y, yaw = T_map_submap.tolist()
    u, v, w = shown.T_map_submap.tolist()
    return math.hypot(x - u, y - v) + abs(se2.wrap(yaw - w)) * shown.patch.reach_m


def spent(one: Drawn, stale: frozenset[Tile]) -> bool:
    """Whether next to nothing of a patch counts any more."""
    return not one.tiles & stale and sum(one.used.values()) < SPENT * max(1, one.patch.weight)


def at_once(pieces: Iterable[tuple[Submap, Sequence[Keyframe]]], resolution: float) -> Grid:
    """Grid of these submaps, oldest first, with their keyframes, in one go.

    Raises:
        ValueError: the resolution is not positive, or the map would have too many cells.
    """
    if not resolution > 0.0:
        raise ValueError(f"map resolution is {resolution} m per cell; it must be positive")
    live = LiveGrid(resolution)
    for number, (submap, frames) in enumerate(pieces, 1):
        alone = Submap(number, submap.first, submap.place(), submap.T_odom_submap)
        live.laid(alone, frames)
    while live.busy():
        live.take(advance(live.task()))
    return live.grid()
