"""Modbus holding registers that clients may write: a command block and an odometry input. Pure: no sockets, no clock.

Both follow one rule, so that a lost, repeated or torn write does no harm. Parameters may be written in any order, and
take effect only with a *new number* in the block's first register. The same number in `acknowledge` confirms a command.
An odometry reading must come in one request, because half of one would be a wrong pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from daemon.publish.modbus.points import I32, U16, U32, Layout, Point, from_client

COMMAND_ADDRESS: Final = 1000
LOOP_ADDRESS: Final = 1050
ODOMETRY_ADDRESS: Final = 1100
MAX_READING_AGE_S: Final = 1.0


class CommandCode(IntEnum):
    """Commands of clients. Numbers are part of the contract: never renumber."""

    SET_POSE = 1  # set the pose to (x, y, yaw) in the map frame
    RESET = 2  # discard map and pose, and restart
    SAVE_MAP = 3  # write the map to the disk; done after it has been read back
    RELOCALISE = 4  # the robot was kidnapped: search the whole map for its pose
    PAUSE = 5  # until RESUME, the map does not change and the lidar does not update the pose
    RESUME = 6  # end a pause
    DUMP_RECORDER = 7  # write the flight recorder's content; done when it is on the disk
    SWITCH_MAP = 8  # switch to the stored map `map_id`; the one in use is saved first


class Outcome(IntEnum):
    """Outcome of a command. Numbers are part of the contract: never renumber."""

    NONE = 0  # no command yet
    RUNNING = 1  # accepted, not finished
    DONE = 2
    REFUSED = 3  # not possible now
    UNKNOWN = 4  # no such command


@dataclass(frozen=True, slots=True)
class Request:
    """A client's command: number, code, and parameters: a pose (m, m, rad), a stored map."""

    number: int
    code: CommandCode
    pose: tuple[float, float, float]
    map_id: int = 0


@dataclass(frozen=True, slots=True)
class WrittenOdometry:
    """A client's odometry reading: cumulative pose (m, m, rad), its age, whether the count restarts."""

    x: float
    y: float
    yaw: float
    age: float
    restarted: bool


_CODES: Final = ", ".join(f"{c.value} {c.name}" for c in CommandCode)
_OUTCOMES: Final = ", ".join(f"{o.value} {o.name}" for o in Outcome)


def _point(name: str, label: str, text: str, access: str = "RW") -> Point:
    return Point(name, label, U16, from_client, text, can_be_unknown=False, access=access)


def _parameters(text: str) -> tuple[Point, ...]:
    return (
        Point("x", f"position x, {text}", I32, from_client, "", 10_000, "m", access="RW"),
        Point("y", f"position y, {text}", I32, from_client, "", 10_000, "m", access="RW"),
        Point("yaw", f"heading, {text}", I32, from_client, "", 1_000_000, "rad", access="RW"),
    )


COMMAND: Final = Layout(
    (
        _point("request", "request number", "A number other than the last one starts the command. Write it last, "
            "or all in one request. Begin with 1, because 0 is acknowledged after a start."),
        _point("command", "command", f"{_CODES}."),
        *_parameters("map frame, for SET_POSE"),
        _point("acknowledge", "acknowledge number", "Number of the last finished request.", "R"),
        _point("result", "result", f"Of the last request: {_OUTCOMES}.", "R"),
        Point("map_id", "map", U32, from_client, "For SWITCH_MAP: the stored map's identity; written before the "
              "request.", can_be_unknown=False, access="RW"),
    )
)  # fmt: skip
_ANSWER_AT: Final = 8  # acknowledge, result: written by the daemon
_WRITABLE: Final = ((0, _ANSWER_AT), (_ANSWER_AT + 2, COMMAND.words))

LOOP: Final = Layout(
    (
        _point("loop_seen", "loop closures seen", "Write the `loop_counter` that was read. The bit "
            "`loop_latched` of `flags` is then clear until the next loop."),
    )
)  # fmt: skip

ODOMETRY: Final = Layout(
    (
        _point("number", "reading number", "Must change with each reading. 0: odometry was restarted and its "
            "pose begins again (1 follows 65535)."),
        Point("age", "age when written", U16, from_client, "Not known: the time of the write counts.", 10_000, "s",
          access="RW"),
        *_parameters("odometry frame, cumulative"),
    )
)  # fmt: skip


class Refused(Exception):
    """An address and length that cannot be read or written (Modbus exception 2)."""


class Holding:
    """The writable registers and their actions.

    Args:
        on_command: called with each new valid command; :meth:`acknowledge` reports its end.
        on_odometry: called with each new reading.
        on_loop_seen: called with the number of loop closures that a client has acknowledged.
    """

    def __init__(
        self,
        on_command: Callable[[Request], None],
        on_odometry: Callable[[WrittenOdometry], None],
        on_loop_seen: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._on_loop_seen = on_loop_seen
        self._loop = bytearray(LOOP.big.size)
        self._on_command = on_command
        self._on_odometry = on_odometry
        self._command = bytearray(COMMAND.big.size)
        self._odometry = bytearray(ODOMETRY.big.size)
        self._number = 0  # of the last request
        self._reading = -1  # number of the last reading; none yet

    def read(self, address: int, count: int) -> bytes:
        """Registers as bytes. Raises Refused for registers that do not exist."""
        blocks = ((COMMAND_ADDRESS, self._command), (ODOMETRY_ADDRESS, self._odometry), (LOOP_ADDRESS, self._loop))
        for start, memory in blocks:
            if start <= address and 2 * (address - start + count) <= len(memory):
                return bytes(memory[2 * (address - start) : 2 * (address - start + count)])
        raise Refused

    def write(self, address: int, data: bytes) -> None:
        """Write registers (big-endian bytes) and act on a new number. Raises Refused where writing is not permitted."""
        at = address - COMMAND_ADDRESS
        if any(begin <= at and at + len(data) // 2 <= end for begin, end in _WRITABLE):
            self._command[2 * at : 2 * at + len(data)] = data
            self._look_for_command()
        elif address == ODOMETRY_ADDRESS and len(data) == len(self._odometry):
            self._odometry[:] = data
            self._take_reading()
        elif address == LOOP_ADDRESS and len(data) == len(self._loop):
            self._loop[:] = data
            self._on_loop_seen(int.from_bytes(data, "big"))
        else:
            raise Refused

    def acknowledge(self, number: int, outcome: Outcome) -> None:
        """Report the outcome of a request to the client; ignored when a newer request has replaced it."""
        if number == self._number:
            self._put_result(number, outcome)

    def _look_for_command(self) -> None:
        values = COMMAND.values(COMMAND.big.unpack(self._command))
        number = int(values["request"] or 0)
        if number == self._number:
            return
        self._number = number
        try:
            code = CommandCode(int(values["command"] or 0))
        except ValueError:
            self._put_result(number, Outcome.UNKNOWN)
            return
        pose = values["x"], values["y"], values["yaw"]
        if code is CommandCode.SET_POSE and None in pose:
            self._put_result(number, Outcome.REFUSED)
            return
        self._put_result(int(values["acknowledge"] or 0), Outcome.RUNNING)
        x, y, yaw = (value or 0.0 for value in pose)
        self._on_command(Request(number, code, (x, y, yaw), int(values["map_id"] or 0)))

    def _put_result(self, acknowledge: int, outcome: Outcome) -> None:
        self._command[2 * _ANSWER_AT : 2 * _ANSWER_AT + 4] = acknowledge.to_bytes(2, "big") + outcome.to_bytes(2, "big")

    def _take_reading(self) -> None:
        values = ODOMETRY.values(ODOMETRY.big.unpack(self._odometry))
        number = int(values["number"] or 0)
        x, y, yaw = values["x"], values["y"], values["yaw"]
        if number == self._reading or x is None or y is None or yaw is None:
            return
        restarted = number == 0 or self._reading < 0
        self._reading = number
        age = min(values["age"] or 0.0, MAX_READING_AGE_S)
        self._on_odometry(WrittenOdometry(x, y, yaw, age, restarted))
