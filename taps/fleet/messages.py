"""What a robot tells its fleet: keys, and messages as JSON. Pure; docs/fleet.md is the contract.

A field never changes its meaning under the same ``schema``; readers skip what they do not know.
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
"""No robot's name begins with @, and no ``*`` meets it."""
MOST_CELLS: Final = 100_000_000
LONGEST_NAME: Final = 32
"""No robot's name is longer (key `name` of the configuration)."""
LONGEST: Final = 1 << 16
"""Bytes of a message, but for a map's cells."""
Cells = npt.NDArray[np.int8]
Told = TypeVar("Told", bound=msgspec.Struct)


class Unreadable(Exception):
    """A message that is not as it should be; the text says what is wrong."""


class PoseTold(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``pose``: where the robot is; ``agvPosition`` as VDA 5050 has it, None before the first pose."""

    schema: int = SCHEMA
    seq: int
    t_utc: float
    agvPosition: dict[str, object] | None = None
    velocity: Triple | None = None
    covariance: tuple[float, float, float, float, float, float] | None = None


class Held(msgspec.Struct, frozen=True):
    """What a robot has taken of what its fleet shares."""

    version: int
    sha256: str
    name: str = ""


class StateTold(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``state``: how the robot is; ``up``: whether its daemon runs."""

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


class LoopTold(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``loops``: a loop closure."""

    schema: int = SCHEMA
    t_utc: float
    counter: int
    residual: float | None = None
    at_new: Triple | None = None
    at_old: Triple | None = None


class MapHead(msgspec.Struct, frozen=True, kw_only=True):
    """Key ``map``, in the attachment: of cells that are deflated, row by row from below, signed bytes."""

    schema: int = SCHEMA
    t_utc: float
    map_id: int
    resolution: float
    columns: int
    rows: int
    origin: tuple[float, float]


def key(robot: str, topic: str) -> str:
    """Where a robot tells a topic."""
    return f"{ROOT}/{robot}/{topic}"


def alive(robot: str, instance: str) -> str:
    """The liveliness token of who speaks for a robot."""
    return f"{ROOT}/{robot}/alive/{instance}"


def waiting(robot: str, instance: str) -> str:
    """The liveliness token of who would speak for a robot, and waits because another does."""
    return f"{ROOT}/{robot}/waiting/{instance}"


def instance_of(session: str, host: str, claimed_ms: int) -> str:
    """Who speaks for a robot: since when, in which session, on which computer. The least of several has the word."""
    return f"{claimed_ms:014d}.{session}.{re.sub(r'[^A-Za-z0-9_.-]', '-', host)}"


def claimed_of(instance: str) -> int:
    """Since when, ms since the Unix epoch; 0 where it is none of ours."""
    first = instance.partition(".")[0]
    return int(first) if first.isascii() and first.isdigit() else 0


def host_of(instance: str) -> str:
    """On which computer."""
    return printable(instance.split(".", 2)[-1])


def printable(text: str) -> str:
    """Without what a terminal takes for orders."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def state_told(pose: Pose, faults: Faults | None, held: dict[str, Held], map_name: str) -> StateTold:
    """How a robot is, of what its daemon told last."""
    return StateTold(
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


def loop_told(loop: Loop, t_utc: float) -> LoopTold:
    """A loop closure."""
    return LoopTold(t_utc=t_utc, counter=loop.counter, residual=loop.residual, at_new=loop.at_new, at_old=loop.at_old)


def encode(told: msgspec.Struct) -> bytes:
    """As JSON."""
    return msgspec.json.encode(told)


def map_told(head: MapHead, cells: Cells) -> tuple[bytes, bytes]:
    """Content and attachment of a map."""
    return zlib.compress(cells.tobytes(), 6), encode(head)


def read_map(content: bytes, attachment: bytes) -> tuple[MapHead, Cells]:
    """A map: head, and (rows, columns) cells.

    Raises:
        Unreadable: it is none.
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
        raise Unreadable(f"a map of {len(cells)} cells that should have {head.columns * head.rows}")
    return head, np.frombuffer(cells, np.int8).reshape(head.rows, head.columns)


def read(data: bytes, kind: type[Told]) -> Told:
    """A message.

    Raises:
        Unreadable: it is not one of that kind, or of another schema.
    """
    if len(data) > LONGEST:
        raise Unreadable(f"a message of {len(data)} bytes, and none has more than {LONGEST}")
    try:
        told = msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise Unreadable(f"no message of a lumiloop ({error})") from None
    schema = getattr(told, "schema", SCHEMA)
    if schema != SCHEMA:
        raise Unreadable(f"schema {schema}, and this program knows {SCHEMA}: install both from the same release")
    return told


def now_ms() -> int:
    """Milliseconds since the Unix epoch."""
    return time.time_ns() // 1_000_000
