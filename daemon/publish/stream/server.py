"""Local stream server: one unix socket that serves every tap (web page, converter, logger) its subscribed topics.

A message is a little-endian length and that many bytes of msgpack, a map with at least ``topic``. A client subscribes
to topics. For a slow client, a newer message of a state-like topic replaces the pending one (and is counted); events (a
loop, a change of state) are queued for it, up to a limit.
No call waits for a client, and without clients nothing is encoded: a tap that hangs costs the daemon a buffer.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from daemon.maps.tiles import NOTHING_SHOWN, RESOLUTION_M, MapTiles
from daemon.publish.local_socket import listening, serve
from daemon.publish.stream.session import CLIENTS, LATEST, ONCE, RAW, SCHEMA, TOPICS, Client, encode, framed
from daemon.snapshot import Snapshot
from hal.adc import RawSamples
from hal.lidar import VALID, RawScan
from hal.net.fair_share import Share

__all__ = [
    "LATEST",
    "ONCE",
    "RAW",
    "SCHEMA",
    "SIDE",
    "TOPICS",
    "UNIT",
    "Client",
    "StreamServer",
    "framed",
    "scan_message",
]

FaultInWords = tuple[int, str, str, int]
"""Number, meaning and remedy of a fault, and the number of the fault it follows from, 0: none."""
Place = Callable[[int], tuple[float, float, float] | None]

TILE_BYTES: Final = 32 << 10
"""Largest size of the deflated tiles in one message, bytes."""
SIDE: Final = 128
UNIT: Final = 0.1
"""Cells of a tile, each way; log-odds of a cell's unit (`estimator.mapping.grid_patches`, which is not loaded here)."""


def scan_message(scan: RawScan) -> dict[str, object]:
    """A scan in SI units: bearings in rad from the lidar's front axis, counter-clockwise, evenly spaced."""
    geometry = scan.geometry
    bearing = geometry.bearings(scan.first_step, scan.stride, 2)
    none = np.where(
        scan.code > geometry.dmax, np.inf, np.nan
    )  # infinite: no echo within range; not a number: no valid distance
    ranges = np.where(scan.code == VALID, scan.ranges * geometry.range_unit_m, none).astype("<f4")
    return {
        "seq": scan.seq,
        "t_mono": scan.t_mono,
        "bearing_first": float(bearing[0]),
        "bearing_step": float(bearing[1] - bearing[0]),
        "ranges": ranges.tobytes(),
        "range_min": geometry.dmin * geometry.range_unit_m,
        "range_max": geometry.dmax * geometry.range_unit_m,
        "beam_dt": geometry.beam_dt_s * scan.stride,
        "period": geometry.period_s,
    }


class StreamServer:
    """Serves the stream at a path in the file system.

    Attributes:
        clients: connected ones. tiles: of the map; None: there are none. share: of the loop's time, for requests.
        place: pose of a keyframe in the map, by ID; None: not available.

    Args:
        path: of the socket; its folder is created. name: of the robot.
        explain: meaning and remedy of a reason's number.
    """

    def __init__(self, path: Path, name: str, explain: Callable[[int], tuple[str, str]]) -> None:
        self.path = path
        self.clients: set[Client] = set()
        self._name = name
        self._explain = explain
        self._latest: Snapshot | None = None
        self._faults: list[dict[str, object]] = []
        self.tiles: MapTiles | None = None
        self.place: Place = _nowhere
        self.share = Share()

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            DeviceRefused: another program serves it, or it cannot be made.
        """
        # every user may connect, because the stream is read-only; the folder's permissions limit access
        with listening("stream", self.path, 0o666, CLIENTS) as sock:
            await serve(sock, CLIENTS, lambda: Client(self), self.clients)

    def hello(self) -> dict[str, object]:
        """First message to a client."""
        return {"topic": "hello", "schema": SCHEMA, "name": self._name, "pid": os.getpid(), "topics": dict(TOPICS)}

    def publish(self, snapshot: Snapshot) -> None:
        """Sink of the cycle: publish a snapshot to the subscribed clients."""
        before, self._latest = self._latest, snapshot
        if self.clients:
            told = self._told(snapshot)
            self._tell("pose", lambda: {**told, **_fields(snapshot)})
            self._tell("lights", lambda: {} if snapshot.light is None else _fields(snapshot.light))
            if before is None or (snapshot.state, snapshot.reason) != (before.state, before.reason):
                self._tell("state", lambda: _state(snapshot, told))
            if snapshot.loop_counter != (0 if before is None else before.loop_counter):
                self._tell("loop", lambda: _loop(snapshot, self.place))

    def _told(self, snapshot: Snapshot) -> dict[str, object]:
        """Name, meaning and remedy of the state."""
        meaning, remedy = self._explain(snapshot.reason)
        return {"state_name": snapshot.state.name, "meaning": meaning, "remedy": remedy}

    def on_scan(self, scan: RawScan) -> None:
        """Publish a scan."""
        self._tell("scan", lambda: scan_message(scan))

    def on_raw(self, device: str, kind: str, t_mono: float, data: bytes) -> None:
        """Publish the traffic of a device's port; ``kind``: rx, tx, open, lost, baud."""
        self._tell("raw", lambda: {"device": device, "kind": kind, "t_mono": t_mono, "bytes": data})

    def on_samples(self, block: RawSamples) -> None:
        """Publish a block of the photodiode's samples."""
        self._tell("raw", lambda: _samples(block))

    def on_faults(self, t_mono: float, faults: Iterable[FaultInWords]) -> None:
        """Publish the present faults if they have changed."""
        told: list[dict[str, object]] = [
            {"fault": number, "meaning": meaning, "remedy": remedy, "cause": cause}
            for number, meaning, remedy, cause in faults
        ]
        if told != self._faults:
            self._faults = told
            self._tell("faults", lambda: {"t_mono": t_mono, "present": told})

    def on_statistics(self, figures: Callable[[], Mapping[str, object]]) -> None:
        """Publish statistics, if a client has subscribed to them."""
        self._tell("statistics", figures)

    def on_tiles(self) -> None:
        """Send new tiles to the subscribed clients."""
        for client in [client for client in self.clients if "map" in client.wants]:
            self.show(client)

    def wanted(self, topic: str) -> bool:
        """Whether a client has subscribed to the topic."""
        return any(topic in client.wants for client in self.clients)

    def welcome(self, client: Client, fresh: frozenset[str]) -> None:
        """Send the present state, faults and tiles to a client that has subscribed to these topics."""
        if "state" in fresh and (snapshot := self._latest) is not None:
            client.tell("state", encode(_state(snapshot, self._told(snapshot))))
        if "faults" in fresh:
            client.tell("faults", encode({"t_mono": None, "present": self._faults}))
        if "map" in fresh:
            client.shown = NOTHING_SHOWN
            self.show(client)

    def show(self, client: Client) -> None:
        """Send the tiles that a client does not have yet, until its buffer is full."""
        tiles = [] if self.tiles is None or client.stuck else self.tiles.since(client.shown)
        while tiles and not client.stuck:
            size = count = 0
            while count < len(tiles) and size < TILE_BYTES:
                size += len(tiles[count][1])
                count += 1
            now, tiles = tiles[:count], tiles[count:]
            client.shown = now[-1][0]
            message = {
                "map_id": 0 if self._latest is None else self._latest.map_id,
                "resolution": RESOLUTION_M,
                "side": SIDE,
                "unit": UNIT,
                "version": client.shown[0],
                "more": bool(tiles),
                "tiles": [[*tile, cells] for (_, tile), cells in now],
            }
            client.tell("map", encode(message))

    def _tell(self, topic: str, data: Callable[[], Mapping[str, object]]) -> None:
        """Encode once and send to all subscribed clients."""
        wanting = [client for client in self.clients if topic in client.wants]
        if wanting:
            body = encode(data())
            for client in wanting:
                client.tell(topic, body)


def _fields(record: object) -> dict[str, Any]:
    built = msgspec.to_builtins(record)
    assert isinstance(built, dict)
    return built


def _samples(block: RawSamples) -> dict[str, object]:
    return {
        "device": "photodiode",
        "kind": "samples",
        "t_mono": block.t_first,
        "rate": block.rate_hz,
        "bits": block.bits,
        "bytes": block.words.astype("<u2").tobytes(),
    }


def _nowhere(keyframe: int) -> None:
    return None


def _state(snapshot: Snapshot, told: Mapping[str, object]) -> dict[str, object]:
    return {"t_mono": snapshot.t_mono, "state": snapshot.state, **told}


def _loop(snapshot: Snapshot, place: Place) -> dict[str, object]:
    return {
        "t_mono": snapshot.t_mono,
        "counter": snapshot.loop_counter,
        "keyframe_new": snapshot.loop_new,
        "keyframe_old": snapshot.loop_old,
        "reason": snapshot.loop_reason,
        "residual": snapshot.loop_residual,
        "at_new": None if snapshot.loop_new is None else place(snapshot.loop_new),
        "at_old": None if snapshot.loop_old is None else place(snapshot.loop_old),
    }
