"""`lumiloop fleet join`: a running daemon tells its fleet where it is and how, under ``lumiloop/<robot>/``.

What was told last of everything is kept and given to who asks (`session.get("lumiloop/*/state")`), so that who comes
late need not wait for a change.
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
from daemon.maps.container import BadMap
from daemon.maps.schema import read
from daemon.maps.store import Store
from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import Faults, Frame, Hello, Loop, MapTiles, NotTheStream, Pose
from daemon.system import console
from hal.run_server import run_until_stopped
from taps.fleet import messages
from taps.fleet.claim import Claim
from taps.fleet.messages import MapHead, PoseTold, StateTold
from taps.fleet.placing import Records
from taps.metrics.vda5050 import position_v2
from taps.stream.tiles import Tiles, trinary
from taps.zenoh_session import BadEndpoint, joined, watched, withdraw

WANTED: Final = ("pose", "loop", "faults", "map")
STATE_S: Final = 5.0
"""The state is told at a change, and so often."""
MAP_S: Final = 10.0
"""The map is told at most so often, and only when it has changed."""
NAME_S: Final = 10.0
"""How often a map's name is looked for that has none yet."""
OLD_S: Final = 3.0
"""A daemon that has told no pose for so long stands, and does not know where the robot is."""


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    stream = Stream(args.stream or args.settings.name, WANTED)
    try:
        asyncio.run(run_until_stopped(tell(args, stream)))
    except BadEndpoint as error:
        return console.fail(str(error), console.USAGE)
    except NotTheStream as error:
        return console.fail(str(error))
    return console.OK


async def tell(args: argparse.Namespace, stream: Stream) -> None:
    """Join the fleet and tell it all, until cancelled.

    Raises:
        BadEndpoint: no such router can be. NotTheStream: there is no such daemon.
    """
    name = args.settings.name
    async with joined(args.router, args.zenoh) as session:
        voice = Voice(session, name)
        robot = Robot(voice, Records(), args.settings.map.folder)
        claim = Claim(session, name, socket.gethostname(), voice.give)
        works = [
            asyncio.create_task(work)
            for work in (
                watched(session, args.router, lambda there: None),
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
            voice.give(False)


class Voice:
    """Tells, while the name is ours, and answers who asks what was told last."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self._session, self._robot = session, robot
        self._latest: dict[str, tuple[bytes, bytes | None]] = {}
        self._answering: zenoh.Queryable[None] | None = None

    def give(self, word: bool) -> None:
        """We have the word, or not."""
        if word and self._answering is None:
            self._answering = self._session.declare_queryable(messages.key(self._robot, "*"), self._answer)
            for key, (content, attachment) in list(self._latest.items()):
                self._session.put(key, content, attachment=attachment)
        elif not word and self._answering is not None:
            withdraw(self._answering)
            self._answering = None

    def say(self, topic: str, content: bytes, attachment: bytes | None = None) -> None:
        """Tell one message; while the word is another's it is kept only."""
        key = messages.key(self._robot, topic)
        self._latest[key] = content, attachment
        if self._answering is not None:
            self._session.put(key, content, attachment=attachment, congestion_control=zenoh.CongestionControl.DROP)

    def _answer(self, query: zenoh.Query) -> None:
        """Called by the session's thread."""
        with query:
            for key, (content, attachment) in list(self._latest.items()):
                if query.key_expr.intersects(key):
                    query.reply(key, content, attachment=attachment)


class Robot:
    """Makes messages of what the daemon tells.

    Args:
        voice: tells them. records: of what is held of the fleet's. folder: of maps, as configured.
    """

    def __init__(self, voice: Voice, records: Records, folder: str) -> None:
        self._voice, self._records, self._folder = voice, records, folder
        self._pose: Pose | None = None
        self._held: Pose | None = None
        self._faults: Faults | None = None
        self._tiles = Tiles()
        self._heard = self._stated = self._drawn = -math.inf
        self._seq = -1
        self._lost = False
        self._said: StateTold | None = None
        self._name: tuple[int, str] = 0, ""
        self._looked = 0.0

    def take(self, frame: Frame | Lost) -> None:
        """Take one in; loops are told at once."""
        match frame:
            case Lost():
                self._pose = self._faults = None
            case Hello():
                self._tiles, self._held = Tiles(), None
            case Pose():
                self._pose, self._heard = frame, time.monotonic()
                self._held = frame if frame.pose is not None else self._held
            case Faults():
                self._faults = frame
            case Loop() if self._pose is not None:
                self._voice.say("loops", messages.encode(messages.loop_told(frame, self._pose.utc(frame.t_mono))))
            case MapTiles():
                self._tiles.take(frame)

    def beat(self) -> None:
        """Tell what is due."""
        now = time.monotonic()
        stands = now - self._heard > OLD_S
        if (pose := self._pose) is not None and not stands:
            if pose.seq != self._seq:
                self._seq, self._lost = pose.seq, False
                self._tell(pose)
        elif (held := self._held) is not None and not self._lost:
            # what was told last is given to who comes late: it must not say that the robot knows its place
            self._seq, self._lost = -1, True
            self._tell(msgspec.structs.replace(held, pose=None, covariance=None, velocity=None))
        state = self._state(stands)
        since = now - self._stated
        if (
            since >= STATE_S
            or self._said is None
            or msgspec.structs.replace(state, t_utc=self._said.t_utc) != self._said
        ):
            self._said, self._stated = state, now
            self._voice.say("state", messages.encode(state))
        if self._tiles.fresh and now - self._drawn >= MAP_S:
            self._drawn = now
            self._draw()

    def _tell(self, pose: Pose) -> None:
        told = PoseTold(
            seq=pose.seq,
            t_utc=pose.utc(pose.t_mono),
            agvPosition=position_v2(pose, self._held, self._map_name(pose.map_id)),
            velocity=pose.velocity,
            covariance=pose.covariance,
        )
        self._voice.say("pose", messages.encode(told))

    def _state(self, stands: bool) -> StateTold:
        if self._pose is None or stands:
            meaning = "the daemon does not answer" if self._pose is None else "the daemon stands"
            return StateTold(t_utc=time.time(), up=False, state_name="DOWN", meaning=meaning, held=self._records.held())
        return messages.state_told(self._pose, self._faults, self._records.held(), self._map_name(self._pose.map_id))

    def _map_name(self, map_id: int) -> str:
        """What its file calls the map; one that has no name yet, or no file, is looked for again."""
        now = time.monotonic()
        if self._name[0] != map_id or (not self._name[1] and now - self._looked >= NAME_S):
            self._name, self._looked = (map_id, name_of(self._folder, map_id)), now
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
        self._voice.say("map", *messages.map_told(head, cells))


def name_of(folder: str, map_id: int) -> str:
    """What the stored map of that identity is called; empty where that is not known."""
    with contextlib.suppress(OSError):
        for one in Store(maps_folder(folder), mend=False).generations():
            if one.map_id == map_id:
                with contextlib.suppress(BadMap):
                    return read(one.path.read_bytes()).meta.name
    return ""


async def beat(robot: Robot, rate: float) -> None:
    """Tell what is due, so many times a second, until cancelled."""
    while True:
        robot.beat()
        await asyncio.sleep(1.0 / rate)


async def follow(stream: Stream, robot: Robot) -> None:
    """Listen to the daemon until cancelled.

    Raises:
        NotTheStream: the other end is no daemon of this version.
    """
    async with contextlib.aclosing(stream.frames()) as frames:
        async for frame in frames:
            if isinstance(frame, Lost):
                console.say(f"{frame.text}; waiting")
            robot.take(frame)
