"""Message queues of the browsers: the latest message of each kind, all events, the present map tiles.

Every message is encoded once for all browsers; a slow browser costs references to the latest ones only.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Final

import msgspec

from daemon.publish.stream.messages import TYPES, Data, Faults, Lights, MapTiles, Pose

KEPT: Final = 64
"""Most queued events."""
LOOPS: Final = 32
"""Loop closures sent to a new viewer."""
PAST_FAULTS: Final = 64
"""Changes of the present faults sent to a new viewer."""
TILES_BYTES: Final = 64 << 10
"""Bytes of tiles in one message, about."""
ROWS: Final = 1200
ROW_S: Final = 0.5
"""Interval of history rows: ten minutes, two per second."""

Tile = tuple[int, int]
ONCE: Final = ("loop", "state")
TOPIC_OF: Final = {kind: topic for topic, kind in TYPES.items()}

encode: Final = msgspec.msgpack.Encoder().encode


def frame(topic: str, data: object) -> bytes:
    """Encode one frame for browsers."""
    return encode({"topic": topic, "data": data})


class Viewer:
    """One browser.

    Attributes:
        number: counts viewers from 1. order: may give commands. replaced: number of frames replaced by newer ones.
    """

    def __init__(self, number: int, order: bool = False) -> None:
        self.number, self.order = number, order
        self.replaced = 0
        self.pending = asyncio.Event()
        self._latest: dict[str, bytes] = {}
        self._once: deque[bytes] = deque(maxlen=KEPT)
        self._tiles: dict[Tile, bytes] = {}
        self._about: dict[str, object] = {}

    def put(self, topic: str, body: bytes, once: bool = False) -> None:
        """Queue a frame; ``once``: an event, else it replaces the last of its topic."""
        if once:
            self.replaced += len(self._once) == KEPT
            self._once.append(body)
        else:
            self.replaced += topic in self._latest
            self._latest[topic] = body
        self.pending.set()

    def put_tiles(self, about: Mapping[str, object], tiles: Iterable[tuple[Tile, bytes]]) -> None:
        """Queue tiles of a map with the common data ``about``; each replaces a queued one at its place."""
        self._about = dict(about)
        self._tiles.update(tiles)
        if self._tiles:
            self.pending.set()

    def clear(self) -> tuple[Tile, ...]:
        """Drop everything queued, for another daemon or time; returns the places of the dropped tiles."""
        waiting = tuple(self._tiles)
        self._latest, self._tiles = {}, {}
        self._once.clear()
        return waiting

    def next_message(self) -> bytes | None:
        """All queued frames as one message, an array, with a part of the tiles. None: nothing is queued."""
        self.pending.clear()
        bodies = [*self._once, *self._latest.values()]
        self._once.clear()
        self._latest = {}
        size, tiles = 0, []
        while self._tiles and size < TILES_BYTES:
            place, cells = next(iter(self._tiles.items()))
            del self._tiles[place]
            size += len(cells)
            tiles.append([*place, cells])
        if tiles:
            bodies.append(frame("map", {**self._about, "tiles": tiles}))
        if self._tiles:
            self.pending.set()
        return b"\xdc" + len(bodies).to_bytes(2, "big") + b"".join(bodies) if bodies else None


Row = tuple[Any, ...]


class History:
    """The last ten minutes of some values, for plots and the trajectory.

    Columns: t_mono; x, y, yaw; the larger sigma (m); protection level (m); computing time of a cycle (us); age of the
    pose at publication (s); links used; state; map jumps; map. None: unknown.
    """

    COLUMNS: ClassVar = ("t", "x", "y", "yaw", "sigma", "bound", "cycle", "late", "used", "state", "jumps", "map")

    def __init__(self) -> None:
        self.rows: deque[Row] = deque(maxlen=ROWS)

    def add(self, pose: Pose, used: int | None) -> Row | None:
        """Add a snapshot; returns the new row, or None where none is due."""
        if self.rows and 0.0 <= pose.t_mono - self.rows[-1][0] < ROW_S:
            return None
        x, y, yaw = pose.pose or (None, None, None)
        covariance = pose.covariance
        sigma = None if covariance is None else max(covariance[0], covariance[2]) ** 0.5
        late = pose.t_sent - pose.t_mono
        figures = (sigma, pose.trust.horizontal_m, pose.cycle_us, late, used)
        row = (pose.t_mono, x, y, yaw, *figures, pose.state, pose.jumps, pose.map_id)
        self.rows.append(row)
        return row


class Hub:
    """Distributes the stream to all viewers, and sends the present state to new ones.

    Attributes:
        viewers: connected ones. session: counts connected daemons; data of an earlier session are invalid.
        up: whether the daemon is connected; why: the cause if it is not.
    """

    def __init__(self) -> None:
        self.viewers: set[Viewer] = set()
        self.session = 0
        self.up, self.why = False, "not connected yet"
        self.history = History()
        self._latest: dict[str, bytes] = {}
        self._loops: deque[Data] = deque(maxlen=LOOPS)
        self._faults: deque[Faults] = deque(maxlen=PAST_FAULTS)
        self._tiles: dict[Tile, bytes] = {}
        self._about: dict[str, object] = {}
        self._used: int | None = None

    def connected(self) -> None:
        """A daemon has connected, perhaps another one: drop all older data."""
        self.session += 1
        self.up, self.why = True, ""
        self.history = History()
        self._latest, self._tiles = {}, {}
        self._loops.clear()
        self._faults.clear()
        for viewer in self.viewers:
            viewer.clear()
        self._broadcast_daemon()

    def disconnected(self, why: str) -> None:
        """The daemon is not connected."""
        if self.up or why != self.why:
            self.up, self.why = False, why
            self._broadcast_daemon()

    def distribute(self, data: Data) -> None:
        """Distribute one stream message."""
        if isinstance(data, MapTiles):
            self._distribute_tiles(data)
            return
        topic = TOPIC_OF[type(data)]
        body, once = frame(topic, data), topic in ONCE
        if topic == "loop":
            self._loops.append(data)
        elif not once:
            self._latest[topic] = body
        if isinstance(data, Faults):
            self._faults.append(data)
        for viewer in self.viewers:
            viewer.put(topic, body, once)
        if isinstance(data, Lights):
            self._used = data.used
        elif isinstance(data, Pose) and (row := self.history.add(data, self._used)) is not None:
            self.broadcast("row", row)

    def broadcast(self, topic: str, data: object) -> None:
        """Send an event to all viewers."""
        body = frame(topic, data)
        for viewer in self.viewers:
            viewer.put(topic, body, once=True)

    def welcome(self, viewer: Viewer) -> None:
        """Add a viewer and send it the present state."""
        self.viewers.add(viewer)
        viewer.put("daemon", frame("daemon", self._daemon()), once=True)
        viewer.put("history", frame("history", list(self.history.rows)), once=True)
        if self._loops:  # as history, not as new events
            viewer.put("loops", frame("loops", list(self._loops)), once=True)
        if self._faults:
            viewer.put("past", frame("past", list(self._faults)), once=True)
        for topic, body in self._latest.items():
            viewer.put(topic, body)
        viewer.put_tiles(self._about, self._tiles.items())

    def _distribute_tiles(self, data: MapTiles) -> None:
        self._about = about_of(data)
        tiles = [((column, row), cells) for column, row, cells in data.tiles]
        self._tiles.update(tiles)
        for viewer in self.viewers:
            viewer.put_tiles(self._about, tiles)

    def _daemon(self) -> dict[str, object]:
        return {"session": self.session, "up": self.up, "why": self.why}

    def _broadcast_daemon(self) -> None:
        self.broadcast("daemon", self._daemon())


def about_of(data: MapTiles) -> dict[str, object]:
    """Data common to all tiles of a map."""
    return {"map_id": data.map_id, "resolution": data.resolution, "side": data.side, "unit": data.unit}
