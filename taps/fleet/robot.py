"""`lumiloop fleet join`: publishes pose, state, loops and map of the running daemon under ``lumiloop/<robot>/``.

The last message of each topic answers queries (`session.get("lumiloop/*/state")`), so that a late subscriber need not
wait for a change.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import socket
import time
from typing import Final

import msgspec
import zenoh

from daemon.config.paths import maps_folder
from daemon.maps.container import MOST_BYTES, BadMap
from daemon.maps.schema import read
from daemon.maps.store import Store
from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import Faults, Frame, Hello, Loop, MapTiles, NotTheStream, Pose
from daemon.system import console
from daemon.system.regular_file import read_regular
from hal.run_server import run_until_stopped
from taps.fleet import messages
from taps.fleet.claim import Claim
from taps.fleet.messages import MapHead, PoseMessage, StateMessage
from taps.fleet.placing import Records
from taps.metrics.vda5050 import localised, position_v2
from taps.stream.tiles import TileMap, trinary
from taps.zenoh_session import BadEndpoint, open_session, undeclare, watch_router

WANTED: Final = ("pose", "loop", "faults", "map")
STATE_S: Final = 5.0
"""Period of the state message, besides one at each change."""
MAP_S: Final = 10.0
"""Least interval of map messages; only a changed map is sent."""
NAME_S: Final = 10.0
"""Interval of searches for the name of a map without one."""
OLD_S: Final = 3.0
"""A daemon without a pose for this long counts as hanging, and its pose as invalid."""


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    stream = Stream(args.stream or args.settings.name, WANTED)
    try:
        asyncio.run(run_until_stopped(join(args, stream)))
    except BadEndpoint as error:
        return console.fail(str(error), console.USAGE)
    except NotTheStream as error:
        return console.fail(str(error))
    return console.OK


async def join(args: argparse.Namespace, stream: Stream) -> None:
    """Join the fleet and publish until cancelled.

    Raises:
        BadEndpoint: invalid endpoint. NotTheStream: the other end is no daemon of this version.
    """
    name = args.settings.name
    async with open_session(args.router, args.zenoh) as session:
        publisher = Publisher(session, name)
        robot = Robot(publisher, Records(), args.settings.map.folder)
        claim = Claim(session, name, socket.gethostname(), publisher.set_active)
        works = [
            asyncio.create_task(work)
            for work in (
                watch_router(session, args.router, lambda present: None),
                claim.run(),
                beat(robot, args.rate),
                follow(stream, robot),
            )
        ]
        try:
            await asyncio.gather(*works)
        finally:
            for work in works:
                work.cancel()
            await asyncio.gather(*works, return_exceptions=True)
            publisher.set_active(False)


class Publisher:
    """Publishes while the name is held, and answers queries with the last messages."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._session, self._robot = session, robot
        self._latest: dict[str, tuple[bytes, bytes | None]] = {}
        self._queryable: zenoh.Queryable[None] | None = None

    def set_active(self, active: bool) -> None:
        """Start or stop publishing, with the claim of the name."""
        if active and self._queryable is None:
            self._queryable = self._session.declare_queryable(messages.key(self._robot, "*"), self._answer)
            for key, (content, attachment) in list(self._latest.items()):
                self._session.put(key, content, attachment=attachment)
        elif not active and self._queryable is not None:
            undeclare(self._queryable)
            self._queryable = None

    def publish(self, topic: str, content: bytes, attachment: bytes | None = None) -> None:
        """Publish one message; while inactive it is only kept."""
        key = messages.key(self._robot, topic)
        self._latest[key] = content, attachment
        if self._queryable is not None:
            self._session.put(key, content, attachment=attachment, congestion_control=zenoh.CongestionControl.DROP)

    def _answer(self, query: zenoh.Query) -> None:
        """Answer a query; called by the session's thread."""
        with query:
            for key, (content, attachment) in list(self._latest.items()):
                if query.key_expr.intersects(key):
                    query.reply(key, content, attachment=attachment)


class Robot:
    """Converts stream messages to fleet messages.

    Args:
        publisher: sends them. records: of installed shared files. folder: of maps, as configured.
    """

    def __init__(self, publisher: Publisher, records: Records, folder: str) -> None:
        self._publisher, self._records, self._folder = publisher, records, folder
        self._pose: Pose | None = None
        self._held: Pose | None = None
        self._faults: Faults | None = None
        self._tiles = TileMap()
        self._t_pose = self._stated = self._drawn = -math.inf
        self._published: Pose | None = None
        self._lost = False
        self._last_state: StateMessage | None = None
        self._name: tuple[int, str] = 0, ""
        self._t_searched = 0.0

    def receive(self, frame: Frame | Lost) -> None:
        """Process one stream message; loop closures are published at once."""
        match frame:
            case Lost():
                self._pose = self._faults = None
            case Hello():
                self._tiles, self._held = TileMap(), None
            case Pose():
                self._pose, self._t_pose = frame, time.monotonic()
                self._held = frame if frame.pose is not None else self._held
            case Faults():
                self._faults = frame
            case Loop() if self._pose is not None:
                self._publisher.publish(
                    "loops", messages.encode(messages.loop_message(frame, self._pose.utc(frame.t_mono)))
                )
            case MapTiles():
                self._tiles.update(frame)

    def beat(self) -> None:
        """Publish what is due."""
        now = time.monotonic()
        hangs = now - self._t_pose > OLD_S
        if (pose := self._pose) is not None and not hangs:
            self._lost = False
            if self._is_new(pose):
                self._publish_pose(pose)
        elif (held := self._held) is not None and not self._lost:
            # late subscribers receive the last message: it must not claim a valid pose
            self._lost = True
            self._publish_pose(msgspec.structs.replace(held, pose=None, covariance=None, velocity=None))
        state = self._state(hangs)
        since = now - self._stated
        if (
            since >= STATE_S
            or self._last_state is None
            or msgspec.structs.replace(state, t_utc=self._last_state.t_utc) != self._last_state
        ):
            self._last_state, self._stated = state, now
            self._publisher.publish("state", messages.encode(state))
        if self._tiles.changed and now - self._drawn >= MAP_S:
            self._drawn = now
            self._draw()

    def _is_new(self, pose: Pose) -> bool:
        """Whether a snapshot has a pose of a later instant than the one published, or its validity has changed."""
        before = self._published
        return before is None or pose.t_mono > before.t_mono or localised(pose) != localised(before)

    def _publish_pose(self, pose: Pose) -> None:
        self._published = pose
        message = PoseMessage(
            seq=pose.seq,
            t_utc=pose.utc(pose.t_mono),
            agvPosition=position_v2(pose, self._held, self._map_name(pose.map_id)),
            velocity=pose.velocity,
            covariance=pose.covariance,
        )
        self._publisher.publish("pose", messages.encode(message))

    def _state(self, hangs: bool) -> StateMessage:
        if self._pose is None or hangs:
            meaning = "the daemon does not answer" if self._pose is None else "the daemon does not respond"
            return StateMessage(
                t_utc=time.time(), up=False, state_name="DOWN", meaning=meaning, held=self._records.held()
            )
        return messages.state_message(self._pose, self._faults, self._records.held(), self._map_name(self._pose.map_id))

    def _map_name(self, map_id: int) -> str:
        """Name of the map in its file; a missing one is searched for again."""
        now = time.monotonic()
        if self._name[0] != map_id or (not self._name[1] and now - self._t_searched >= NAME_S):
            self._name, self._t_searched = (map_id, name_of(self._folder, map_id)), now
        return self._name[1]

    def _draw(self) -> None:
        corner, log_odds = self._tiles.whole()
        cells = trinary(log_odds)
        head = MapHead(
            t_utc=time.time(),
            map_id=self._tiles.map_id,
            resolution=self._tiles.resolution,
            columns=cells.shape[1],
            rows=cells.shape[0],
            origin=corner,
        )
        self._publisher.publish("map", *messages.map_message(head, cells))


def name_of(folder: str, map_id: int) -> str:
    """Name of the stored map with that ID; empty where unknown."""
    with contextlib.suppress(OSError):
        for one in Store(maps_folder(folder), mend=False).generations():
            if one.map_id == map_id:
                with contextlib.suppress(BadMap):
                    return read(read_regular(one.path, MOST_BYTES)).meta.name
    return ""


async def beat(robot: Robot, rate: float) -> None:
    """Publish what is due, ``rate`` times per second, until cancelled."""
    while True:
        robot.beat()
        await asyncio.sleep(1.0 / rate)


async def follow(stream: Stream, robot: Robot) -> None:
    """Read the stream until cancelled.

    Raises:
        NotTheStream: the other end is no daemon of this version.
    """
    async with contextlib.aclosing(stream.frames()) as frames:
        async for frame in frames:
            if isinstance(frame, Lost):
                console.say(f"{frame.text}; waiting")
            robot.receive(frame)
