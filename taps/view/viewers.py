"""What each browser still has to be told: the latest of its kind, all that happened once, tiles as they are by then.

Everything is encoded once, for all; a browser that does not keep up costs this process references to the latest.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Final

import msgspec

from daemon.publish.stream.messages import TYPES, Data, Lights, MapTiles, Pose

KEPT: Final = 64
"""Of what happens once."""
LOOPS: Final = 32
"""Of the latest, that a newcomer is told."""
TILES_BYTES: Final = 64 << 10
"""Of tiles in one message."""
ROWS: Final = 1200
ROW_S: Final = 0.5
"""Rows of history: ten minutes, two a second."""

Tile = tuple[int, int]
ONCE: Final = ("loop", "state")
TOPIC_OF: Final = {kind: topic for topic, kind in TYPES.items()}

encode: Final = msgspec.msgpack.Encoder().encode


def frame(topic: str, data: object) -> bytes:
    """One frame as browsers read it."""
    return encode({"topic": topic, "data": data})


class Viewer:
    """One browser.

    Attributes:
        number: counts viewers from 1. order: may give orders. replaced: frames that a newer one has replaced.
    """

    def __init__(self, number: int, order: bool = False) -> None:
        self.number, self.order = number, order
        self.replaced = 0
        self.some = asyncio.Event()
        self._latest: dict[str, bytes] = {}
        self._once: deque[bytes] = deque(maxlen=KEPT)
        self._tiles: dict[Tile, bytes] = {}
        self._about: dict[str, object] = {}

    def put(self, topic: str, body: bytes, once: bool = False) -> None:
        """Have it told."""
        if once:
            self.replaced += len(self._once) == KEPT
            self._once.append(body)
        else:
            self.replaced += topic in self._latest
            self._latest[topic] = body
        self.some.set()

    def put_tiles(self, about: Mapping[str, object], tiles: Iterable[tuple[Tile, bytes]]) -> None:
        """Have it told tiles, of a map that is described by ``about``; each replaces one that still waits."""
        self._about = dict(about)
        self._tiles.update(tiles)
        if self._tiles:
            self.some.set()

    def forget(self) -> tuple[Tile, ...]:
        """What still waits is of a world that has gone; returns the tiles that it has not been told."""
        waiting = tuple(self._tiles)
        self._latest, self._tiles = {}, {}
        self._once.clear()
        return waiting

    def take(self) -> bytes | None:
        """All that waits as one message, an array of frames; of tiles only some. None: nothing waits."""
        self.some.clear()
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
            self.some.set()
        return b"\xdc" + len(bodies).to_bytes(2, "big") + b"".join(bodies) if bodies else None


Row = tuple[Any, ...]


class History:
    """The last ten minutes of a few figures, for plots and the way behind the robot.

    Columns: t_mono; x, y, yaw; the larger sigma (m); bound (m); computing time of a cycle (us); how late the pose was
    published (s); links used; state; map jumps; map. None: not known.
    """

    COLUMNS: ClassVar = ("t", "x", "y", "yaw", "sigma", "bound", "cycle", "late", "used", "state", "jumps", "map")

    def __init__(self) -> None:
        self.rows: deque[Row] = deque(maxlen=ROWS)

    def take(self, pose: Pose, used: int | None) -> Row | None:
        """A snapshot; returns the row that it has made, None: it is not time for one."""
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
    """Hands on what comes from the stream, and tells newcomers how things stand.

    Attributes:
        viewers: that are there. session: counts daemons that were met; what was told of an earlier one counts no more.
        up: whether the daemon is there; why: if not, why.
    """

    def __init__(self) -> None:
        self.viewers: set[Viewer] = set()
        self.session = 0
        self.up, self.why = False, "not connected yet"
        self.history = History()
        self._latest: dict[str, bytes] = {}
        self._loops: deque[Data] = deque(maxlen=LOOPS)
        self._tiles: dict[Tile, bytes] = {}
        self._about: dict[str, object] = {}
        self._used: int | None = None

    def met(self) -> None:
        """A daemon is there, perhaps another one: what was known counts no more."""
        self.session += 1
        self.up, self.why = True, ""
        self.history = History()
        self._latest, self._tiles = {}, {}
        self._loops.clear()
        for viewer in self.viewers:
            viewer.forget()
        self._tell_up()

    def lost(self, why: str) -> None:
        """It is not there."""
        if self.up or why != self.why:
            self.up, self.why = False, why
            self._tell_up()

    def take(self, data: Data) -> None:
        """One frame of the stream."""
        if isinstance(data, MapTiles):
            self._take_tiles(data)
            return
        topic = TOPIC_OF[type(data)]
        body, once = frame(topic, data), topic in ONCE
        if topic == "loop":
            self._loops.append(data)
        elif not once:
            self._latest[topic] = body
        for viewer in self.viewers:
            viewer.put(topic, body, once)
        if isinstance(data, Lights):
            self._used = data.used
        elif isinstance(data, Pose) and (row := self.history.take(data, self._used)) is not None:
            self.tell("row", row)

    def tell(self, topic: str, data: object) -> None:
        """Tell all, once."""
        body = frame(topic, data)
        for viewer in self.viewers:
            viewer.put(topic, body, once=True)

    def welcome(self, viewer: Viewer) -> None:
        """Tell one how things stand."""
        self.viewers.add(viewer)
        viewer.put("daemon", frame("daemon", self._daemon()), once=True)
        viewer.put("history", frame("history", list(self.history.rows)), once=True)
        if self._loops:  # as what has been, not as what happens now
            viewer.put("loops", frame("loops", list(self._loops)), once=True)
        for topic, body in self._latest.items():
            viewer.put(topic, body)
        viewer.put_tiles(self._about, self._tiles.items())

    def _take_tiles(self, data: MapTiles) -> None:
        self._about = about_of(data)
        tiles = [((column, row), cells) for column, row, cells in data.tiles]
        self._tiles.update(tiles)
        for viewer in self.viewers:
            viewer.put_tiles(self._about, tiles)

    def _daemon(self) -> dict[str, object]:
        return {"session": self.session, "up": self.up, "why": self.why}

    def _tell_up(self) -> None:
        self.tell("daemon", self._daemon())


def about_of(data: MapTiles) -> dict[str, object]:
    """What is the same for all tiles of a map."""
    return {"map_id": data.map_id, "resolution": data.resolution, "side": data.side, "unit": data.unit}
