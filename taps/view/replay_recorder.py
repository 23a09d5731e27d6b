"""Writes the replay file of a recording: one run of the daemon's pipeline, with the stream's messages stored by time.

It runs in a process of its own at low priority, faster than real time. Messages are thinned to a visible rate.
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
from daemon.replay.sources import Source
from daemon.runtime import warmup
from hal.errors import HalError
from hal.lidar import RawScan
from taps.view.page_hello import scene_of
from taps.view.replay_file import end_message, message
from taps.view.viewers import History, about_of, encode, frame

TOPICS: Final = frozenset({"pose", "lights", "scan", "state", "loop", "faults", "map"})
THINNED: Final = ("pose", "lights", "scan")
STEP_S: Final = 0.05
"""Least interval of stored poses."""
BEAT_S: Final = 1.0
"""Interval of map and fault updates, in the recording's time."""
DRAWN_S: Final = 20.0

_pose: Final = msgspec.msgpack.Decoder(messages.Pose).decode
_lights: Final = msgspec.msgpack.Decoder(messages.Lights).decode
_map: Final = msgspec.msgpack.Decoder(messages.MapTiles).decode


class ReplayRecorder(Client):
    """A client of the stream server in this process, which writes the messages to the replay file."""

    def __init__(self, server: StreamServer, out: BinaryIO) -> None:
        super().__init__(server)
        self.wants = TOPICS
        self.t_mono = 0.0
        self.t_first: float | None = None
        self._out = out
        self._last: dict[str, float] = {}
        self._history, self._used = History(), 0

    def tell(self, topic: str, body: bytes) -> None:
        """Write a message, unless it is thinned out."""
        if topic == "map":
            self._keep_tiles(_map(body))
            return
        if topic in THINNED:
            if self.t_mono - self._last.get(topic, -1e9) < STEP_S - 1e-3:
                return
            self._last[topic] = self.t_mono
        if topic == "pose" and (row := self._history.add(_pose(body), self._used)) is not None:
            self._write("row", frame("row", row))
        elif topic == "lights":
            self._used = _lights(body).used
        self._write(topic, frame(topic, msgspec.Raw(body)))

    def scene(self, scene: dict[str, object]) -> None:
        """Write the scene of the recorded robot."""
        self._write("scene", encode(scene))
        self._out.flush()

    def end(self, error: str) -> None:
        """Write the end message."""
        self._out.write(end_message(self.t_mono, error))
        self._out.flush()

    def flush(self) -> None:
        """Make the written messages visible to readers."""
        self._out.flush()

    def _keep_tiles(self, scene: messages.MapTiles) -> None:
        about = about_of(scene)
        for column, row, cells in scene.tiles:
            self._write("map", encode([column, row, cells, about]))

    def _write(self, kind: str, body: bytes) -> None:
        self._out.write(message(self.t_mono, kind, body))


def record(source: Source, settings: Config, given: tuple[bool, tuple[str, ...]], out: Path) -> None:
    """Write the replay file at low priority: the body of a process."""
    with contextlib.suppress(OSError):
        os.nice(10)
    with contextlib.suppress(KeyboardInterrupt):
        make(source, settings, given, out)


def make(source: Source, settings: Config, given: tuple[bool, tuple[str, ...]], out: Path) -> None:
    """Write the replay file. ``given``: see `daemon.replay.recorded_inputs.Given`.

    An error of the recording is stored in the end message.

    Raises:
        OSError: the replay file cannot be written; it ends there.
    """
    asyncio.run(_record(source, settings, Given(*given), out))


async def _record(source: Source, settings: Config, given: Given, out: Path) -> None:
    with out.open("wb") as file:
        server = StreamServer(out, settings.name, lambda reason: REASONS[Reason(reason)])
        recorder = ReplayRecorder(server, file)
        server.clients.add(recorder)
        error = ""
        try:
            await _run(source, settings, given, server, recorder)
        except (HalError, SurveyError, warmup.CannotLoad, OSError, ValueError) as problem:
            error = str(problem) or type(problem).__name__
        finally:
            recorder.end(error)


async def _run(source: Source, settings: Config, given: Given, server: StreamServer, recorder: ReplayRecorder) -> None:
    used = config_for(source, settings, given)
    lights = lights_for(source, used, given)
    recorder.scene(asdict(scene_of(used, None if lights is None else lights.survey)))
    warmup.load(lights)
    rerun = Rerun(source, used, lights, None, start_for(source, used, lights, given))
    rerun.cycle.parts.sinks.append(server.publish)
    server.place = partial(place_of, lambda: rerun.state)
    server.tiles = tiles = MapTiles(lambda: rerun.state, server.on_tiles)
    beat_at = -1.0
    for event in source.events():
        recorder.t_mono = max(recorder.t_mono, rerun.t_mono)
        if isinstance(event, RawScan):
            server.on_scan(event)
        rerun.feed(event)
        if rerun.t_mono >= beat_at:
            recorder.t_mono, beat_at = rerun.t_mono, rerun.t_mono + BEAT_S
            server.on_faults(rerun.t_mono, in_words(rerun.faults))
            await _draw(tiles)
            recorder.flush()
    await _draw(tiles)
    tiles.close()


async def _draw(tiles: MapTiles) -> None:
    """Render the present map and wait for it."""
    tiles.follow(asyncio.get_running_loop())
    end = time.monotonic() + DRAWN_S
    while tiles.busy and time.monotonic() < end:  # noqa: ASYNC110  unchanged tiles cause no callback
        await asyncio.sleep(0.002)
