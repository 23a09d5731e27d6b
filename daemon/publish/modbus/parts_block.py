"""Modbus block for health: every present fault, restarts by component, hanging threads, uptime.

    Modbus    magic u16, version u16 | seq u32, POINTS, big-endian, high word first | seq_end u32     at 400

The contract is that of the other tables: under the same version a point never moves and never changes its meaning.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Final

from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import U16, U32, Point, Rule, Value
from daemon.snapshot import NO_CONDITION, Condition, Part, Snapshot, Thread

FAULTS: Final = 12
"""Largest number of faults that the block lists; more are only counted."""

PARTS: Final = {
    Part.LIDAR: "lidar driver: restarts of stream and port",
    Part.PHOTODIODE: "converter driver: recoveries",
    Part.ODOMETRY: "port for odometry",
    Part.IMU: "port for gyro readings",
    Part.MODBUS: "Modbus server on UDP and TCP",
    Part.RTU: "Modbus server on a serial line",
    Part.POSE: "sender of pose datagrams",
    Part.SUBSCRIPTIONS: "port for subscriptions to pose datagrams",
    Part.STREAM: "the local stream",
    Part.MAP: "autosave of the map",
    Part.OTHER: "anything else",
}
"""Meaning of the components, by number. Part of the contract: never renumber."""
THREADS: Final = {
    Thread.SOLVER: "a computation that the pose needs; after two minutes the watchdog ends the daemon",
    Thread.SEARCH: "a search in the background; after two minutes the watchdog ends the daemon",
    Thread.MAP: "saving the map: check the disk",
    Thread.POSE: "storing the pose for the next start: check the disk",
    Thread.RECORDING: "the recording: check the disk",
    Thread.I2C: "a transaction on the photodiode's bus: check the bus",
}
"""Meaning of the threads, by number. Part of the contract: never renumber."""

Getter = Callable[[Snapshot], Value]


def _condition(snapshot: Snapshot) -> Condition:
    return snapshot.condition or NO_CONDITION


def _fault(place: int) -> Getter:
    def get(snapshot: Snapshot) -> Value:
        faults = _condition(snapshot).faults
        return faults[place] if place < len(faults) else 0

    return get


def _restarts(part: Part) -> Getter:
    return lambda snapshot: _condition(snapshot).restarts[part]


def _bits(name: str) -> Getter:
    members = attrgetter(name)
    return lambda snapshot: sum(1 << int(member) for member in members(_condition(snapshot)))


def _names(meanings: dict[Part, str] | dict[Thread, str]) -> str:
    return ", ".join(f"{int(member)} {member.name}" for member in meanings)


POINTS: Final = (
    Point("uptime", "time since the start", U32, lambda s: _condition(s).uptime_s, "Of the process.",
          unit="s", can_be_unknown=False),
    Point("faults", "faults present", U16, lambda s: len(_condition(s).faults),
          "The gravest are listed below, each before those that follow from it.", can_be_unknown=False),
    *(
        Point(f"fault_{k + 1}", "fault" if k else "gravest fault", U16, _fault(k), "0: no further fault.",
              can_be_unknown=False)
        for k in range(FAULTS)
    ),
    *(
        Point(f"restarts_{part.name.lower()}", f"restarts, {part.name}", U16, _restarts(part),
              f"{text[0].upper()}{text[1:]}.", rule=Rule.WRAP, can_be_unknown=False)
        for part, text in PARTS.items()
    ),
    Point("down", "components that are down", U16, _bits("down"),
          f"Bits: {_names(PARTS)}. Components of the program only; a missing device is a fault.",
          can_be_unknown=False),
    Point("hanging", "threads that do not respond", U16, _bits("hanging"), f"Bits: {_names(THREADS)}.",
          can_be_unknown=False),
)  # fmt: skip

BLOCK: Final = Block("the parts", 400, "LF", 1, POINTS)
