"""The fleet's protocol: Zenoh keys, and messages as JSON (docs/fleet.md). Pure.

A field never changes its meaning under the same ``schema``; readers skip unknown fields.
"""

from __future__ import annotations

import re
import time
import zlib
from typing import Final, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from daemon.publish.stream.messages import Fault, Faults, Loop, Pose, Triple

SCHEMA: Final = 1
ROOT: Final = "lumiloop"
TOPICS: Final = ("pose", "state", "loops", "map")
SHARED: Final = f"{ROOT}/@shared"
"""No robot's name begins with @, and no ``*`` matches it."""
MOST_CELLS: Final = 100_000_000
LONGEST_NAME: Final = 32
"""Longest name of a robot (key `name` of the configuration)."""
LONGEST: Final = 1 << 16
"""Most bytes of a message, without a map's cells."""
Cells = npt.NDArray[np.int8]
Message = TypeVar("Message", bound=msgspec.Struct)


class Unreadable(Exception):
    """An invalid message; the text gives the cause."""


class PoseMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``pose``: the robot's pose; ``agvPosition`` of VDA 5050, None before the first pose."""

    schema: int = SCHEMA
    seq: int
    t_utc: float
    agvPosition: dict[str, object] | None = None
    velocity: Triple | None = None
    covariance: tuple[float, float, float, float, float, float] | None = None


class Held(msgspec.Struct, frozen=True):
    """A shared file that a robot has installed."""

    version: int
    sha256: str
    name: str = ""


class StateMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``state``: the robot's state; ``up``: whether its daemon runs."""

    schema: int = SCHEMA
    t_utc: float
    up: bool = True
    state: int = 0
    state_name: str = ""
    meaning: str = ""
    remedy: str = ""
    alert: bool = False
    jumps: int = 0
    map_id: int = 0
    map_name: str = ""
    faults: tuple[Fault, ...] = ()
    held: dict[str, Held] = {}


class LoopMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``loops``: a loop closure."""

    schema: int = SCHEMA
    t_utc: float
    counter: int
    residual: float | None = None
    at_new: Triple | None = None
    at_old: Triple | None = None


class MapHead(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``map``, the attachment; the content is the deflated cells, row by row from below, signed bytes."""

    schema: int = SCHEMA
    t_utc: float
    map_id: int
    resolution: float
    columns: int
    rows: int
    origin: tuple[float, float]


def key(robot: str, topic: str) -> str:
    """Zenoh key of a robot's topic."""
    return f"{ROOT}/{robot}/{topic}"


def alive(robot: str, instance: str) -> str:
    """Key of the liveliness token of a robot's publisher."""
    return f"{ROOT}/{robot}/alive/{instance}"


def waiting(robot: str, instance: str) -> str:
    """Key of the liveliness token of a claimant that waits for a robot's name."""
    return f"{ROOT}/{robot}/waiting/{instance}"


def instance_of(session: str, host: str, claimed_ms: int) -> str:
    """ID of a claimant: time of the claim, session, host. The smallest of several has precedence."""
    return f"{claimed_ms:014d}.{session}.{re.sub(r'[^A-Za-z0-9_.-]', '-', host)}"


def claimed_of(instance: str) -> int:
    """Time of a claim, ms since the Unix epoch; 0 for a foreign ID."""
    first = instance.partition(".")[0]
    return int(first) if first.isascii() and first.isdigit() else 0


def host_of(instance: str) -> str:
    """Host of a claimant."""
    return printable(instance.split(".", 2)[-1])


def printable(text: str) -> str:
    """Text without control characters for a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def state_message(pose: Pose, faults: Faults | None, held: dict[str, Held], map_name: str) -> StateMessage:
    """The state message for the latest stream messages."""
    return StateMessage(
        t_utc=pose.utc(pose.t_mono),
        state=pose.state,
        state_name=pose.state_name,
        meaning=pose.meaning,
        remedy=pose.remedy,
        alert=pose.trust.alert,
        jumps=pose.jumps,
        map_id=pose.map_id,
        map_name=map_name,
        faults=() if faults is None else faults.present,
        held=held,
    )


def loop_message(loop: Loop, t_utc: float) -> LoopMessage:
    """The message of a loop closure."""
    return LoopMessage(
        t_utc=t_utc, counter=loop.counter, residual=loop.residual, at_new=loop.at_new, at_old=loop.at_old
    )


def encode(message: msgspec.Struct) -> bytes:
    """Encode as JSON."""
    return msgspec.json.encode(message)


def map_message(head: MapHead, cells: Cells) -> tuple[bytes, bytes]:
    """Content and attachment of a map."""
    return zlib.compress(cells.tobytes(), 6), encode(head)


def read_map(content: bytes, attachment: bytes) -> tuple[MapHead, Cells]:
    """A map: head, and (rows, columns) cells.

    Raises:
        Unreadable: not a valid map.
    """
    head = read(attachment, MapHead)
    if head.columns < 1 or head.rows < 1 or head.columns * head.rows > MOST_CELLS:
        raise Unreadable(f"a map of {head.columns} x {head.rows} cells")
    if not (head.resolution > 0.0 and np.isfinite([head.resolution, *head.origin]).all()):
        raise Unreadable(f"a map with cells of {head.resolution} m at {head.origin}")
    try:
        cells = zlib.decompressobj().decompress(content, head.columns * head.rows + 1)
    except zlib.error as error:
        raise Unreadable(f"a map that cannot be inflated ({error})") from None
    if len(cells) != head.columns * head.rows:
        raise Unreadable(f"a map of {len(cells)} cells instead of {head.columns * head.rows}")
    return head, np.frombuffer(cells, np.int8).reshape(head.rows, head.columns)


def read(data: bytes, kind: type[Message]) -> Message:
    """Decode a message.

    Raises:
        Unreadable: not a message of that kind, or of another schema.
    """
    if len(data) > LONGEST:
        raise Unreadable(f"the message has {len(data)} bytes; the limit is {LONGEST}")
    try:
        message = msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise Unreadable(f"not a lumiloop message ({error})") from None
    schema = getattr(message, "schema", SCHEMA)
    if schema != SCHEMA:
        raise Unreadable(f"schema {schema}, but this program has {SCHEMA}; install both from the same release")
    return message


def now_ms() -> int:
    """Milliseconds since the Unix epoch."""
    return time.time_ns() // 1_000_000
