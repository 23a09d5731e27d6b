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
    Part.LIDAR: "the lidar's driver: streams begun anew, and ports",
    Part.PHOTODIODE: "the converter's driver: times it delivered again after trouble",
    Part.ODOMETRY: "the port that takes odometry",
    Part.IMU: "the port that takes gyro readings",
    Part.MODBUS: "the Modbus server on UDP and TCP",
    Part.RTU: "the Modbus server on a serial line",
    Part.POSE: "the sender of pose datagrams",
    Part.SUBSCRIPTIONS: "the port at which pose datagrams are subscribed",
    Part.STREAM: "the local stream",
    Part.MAP: "the keeper of the map",
    Part.OTHER: "anything else",
}
"""Meaning of the components, by number. Part of the contract: never renumber."""
THREADS: Final = {
    Thread.SOLVER: "a computation that the pose waits for; after two minutes the watchdog ends the daemon",
    Thread.SEARCH: "a search in the background; after two minutes the watchdog ends the daemon",
    Thread.MAP: "a save of the map: look at the disk",
    Thread.POSE: "what keeps the pose for the next start: look at the disk",
    Thread.RECORDING: "the recording: look at the disk",
    Thread.I2C: "a transaction on the photodiode's bus: look at the bus",
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
          "The gravest are named below, each before those that follow from it.", can_be_unknown=False),
    *(
        Point(f"fault_{k + 1}", "fault" if k else "gravest fault", U16, _fault(k), "0: no further one.",
              can_be_unknown=False)
        for k in range(FAULTS)
    ),
    *(
        Point(f"restarts_{part.name.lower()}", f"restarts, {part.name}", U16, _restarts(part), f"{text.capitalize()}.",
              rule=Rule.WRAP, can_be_unknown=False)
        for part, text in PARTS.items()
    ),
    Point("down", "parts that are down", U16, _bits("down"),
          f"Bits: {_names(PARTS)}. Of the program: a device that is gone is a fault and no bit here.",
          can_be_unknown=False),
    Point("hanging", "threads that have not come back", U16, _bits("hanging"), f"Bits: {_names(THREADS)}.",
          can_be_unknown=False),
)  # fmt: skip

BLOCK: Final = Block("the parts", 400, "LF", 1, POINTS)
