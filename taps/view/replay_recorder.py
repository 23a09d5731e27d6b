"""Makes a film of a recording: the daemon's own pipeline runs over it once, and what the stream would tell is kept.

In a process of its own, at low priority; it is faster than the recording was. The film is thinned to what an eye can
tell apart.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError
from daemon.health.reasons import REASONS, Reason
from daemon.maps.tiles import MapTiles
from daemon.publish.stream import messages
from daemon.publish.stream.server import Client, StreamServer
from daemon.publish.stream.ticker import in_words, place_of
from daemon.replay.recorded_inputs import Given, config_for, lights_for, start_for
from daemon.replay.runner import Rerun
from daemon.replay.sources import open_log
from daemon.runtime import warmup
from hal.errors import HalError
from hal.lidar import RawScan
from taps.view.page_hello import scene_of
from taps.view.replay_file import HEAD, KINDS
from taps.view.viewers import History, about_of, encode, frame

TOPICS: Final = frozenset({"pose", "lights", "scan", "state", "loop", "faults", "map"})
THINNED: Final = ("pose", "lights", "scan")
STEP_S: Final = 0.05
"""Between two poses of a film."""
BEAT_S: Final = 1.0
"""Of the recording's time, between two looks at the map, and at what is wrong."""
DRAWN_S: Final = 20.0

_pose: Final = msgspec.msgpack.Decoder(messages.Pose).decode
_lights: Final = msgspec.msgpack.Decoder(messages.Lights).decode
_map: Final = msgspec.msgpack.Decoder(messages.MapTiles).decode


class Camera(Client):
    """A client of a stream that nobody serves: what it is told is written to the film."""

    def __init__(self, server: StreamServer, out: BinaryIO) -> None:
        super().__init__(server)
        self.wants = TOPICS
        self.t_mono = 0.0
        self.t_first: float | None = None
        self._out = out
        self._last: dict[str, float] = {}
        self._history, self._used = History(), 0

    def tell(self, topic: str, body: bytes) -> None:
        """Keep it, if it is worth it."""
        if topic == "map":
            self._keep_tiles(_map(body))
            return
        if topic in THINNED:
            if self.t_mono - self._last.get(topic, -1e9) < STEP_S - 1e-3:
                return
            self._last[topic] = self.t_mono
        if topic == "pose" and (row := self._history.take(_pose(body), self._used)) is not None:
            self._write("row", frame("row", row))
        elif topic == "lights":
            self._used = _lights(body).used
        self._write(topic, frame(topic, msgspec.Raw(body)))

    def scene(self, told: dict[str, object]) -> None:
        """What the robot was like."""
        self._write("scene", encode(told))
        self._out.flush()

    def end(self, error: str) -> None:
        """There is no more."""
        self._write("end", error.encode())
        self._out.flush()

    def flush(self) -> None:
        """Let it be read."""
        self._out.flush()

    def _keep_tiles(self, told: messages.MapTiles) -> None:
        about = about_of(told)
        for column, row, cells in told.tiles:
            self._write("map", encode([column, row, cells, about]))

    def _write(self, kind: str, body: bytes) -> None:
        self._out.write(HEAD.pack(self.t_mono, KINDS.index(kind), len(body)))
        self._out.write(body)


def shoot(log: Path, settings: Config, given: tuple[bool, tuple[str, ...]], out: Path) -> None:
    """Make the film, out of the way of others: the body of a process of its own."""
    with contextlib.suppress(OSError):
        os.nice(10)
    with contextlib.suppress(KeyboardInterrupt):
        make(log, settings, given, out)


def make(log: Path, settings: Config, given: tuple[bool, tuple[str, ...]], out: Path) -> None:
    """Make the film. ``given``: see `daemon.replay.recorded_inputs.Given`. An error in the recording ends the film.

    Raises:
        OSError: the film cannot be written; it lasts as far as it came.
    """
    asyncio.run(_shoot(log, settings, Given(*given), out))


async def _shoot(log: Path, settings: Config, given: Given, out: Path) -> None:
    with out.open("wb") as file:
        server = StreamServer(out, settings.name, lambda reason: REASONS[Reason(reason)])
        camera = Camera(server, file)
        server.clients.add(camera)
        error = ""
        try:
            await _run(log, settings, given, server, camera)
        except (HalError, SurveyError, warmup.CannotLoad, OSError, ValueError) as problem:
            error = str(problem) or type(problem).__name__
        finally:
            camera.end(error)


async def _run(log: Path, settings: Config, given: Given, server: StreamServer, camera: Camera) -> None:
    source = open_log(log)
    used = config_for(source, settings, given)
    lights = lights_for(source, used, given)
    camera.scene(asdict(scene_of(used, None if lights is None else lights.survey)))
    warmup.load(lights)
    rerun = Rerun(source, used, lights, None, start_for(source, used, lights, given))
    rerun.cycle.parts.sinks.append(server.publish)
    server.place = partial(place_of, lambda: rerun.state)
    server.tiles = tiles = MapTiles(lambda: rerun.state, server.on_tiles)
    beat_at = -1.0
    for event in source.events():
        camera.t_mono = max(camera.t_mono, rerun.t_mono)
        if isinstance(event, RawScan):
            server.on_scan(event)
        rerun.feed(event)
        if rerun.t_mono >= beat_at:
            camera.t_mono, beat_at = rerun.t_mono, rerun.t_mono + BEAT_S
            server.on_faults(rerun.t_mono, in_words(rerun.faults))
            await _draw(tiles)
            camera.flush()
    await _draw(tiles)
    tiles.close()


async def _draw(tiles: MapTiles) -> None:
    """Have the map drawn as it is now, and wait for it."""
    tiles.follow(asyncio.get_running_loop())
    end = time.monotonic() + DRAWN_S
    while tiles.busy and time.monotonic() < end:  # noqa: ASYNC110  tiles that are the same tell nobody
        await asyncio.sleep(0.002)
