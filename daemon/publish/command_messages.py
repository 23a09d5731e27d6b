"""Messages of the local command socket: one line of JSON each way.

A request names a command and its parameters, a reply its outcome:

    {"command": "set_pose", "x_m": 1.0, "y_m": 2.0, "yaw_rad": 1.57}
    {"schema": "lumiloop.command/1", "command": "set_pose", "result": "done", "reason": "", "state": "RELOCATING", ...}
"""

from __future__ import annotations

import math
from typing import Any, Final

import msgspec

from daemon.publish.modbus.holding import CommandCode, Outcome, Request
from daemon.snapshot import Snapshot

SCHEMA: Final = "lumiloop.command/1"
LONGEST_REQUEST: Final = 1024
"""Largest size of a request, bytes."""
FARTHEST_M: Final = 100_000.0
"""Largest coordinate of a pose, m."""
MAP_IDS: Final = 1 << 32


class BadRequest(Exception):
    """A request that names no command, or wrong parameters; the text states the reason."""


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    command: str
    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None
    map_id: int | None = None


_decode: Final = msgspec.json.Decoder(_Line).decode


def request_line(request: Request) -> bytes:
    """Encode a command as a client sends it."""
    message: dict[str, Any] = {"command": request.code.name.lower()}
    if request.code is CommandCode.SET_POSE:
        message |= dict(zip(("x_m", "y_m", "yaw_rad"), request.pose, strict=True))
    if request.code is CommandCode.SWITCH_MAP:
        message["map_id"] = request.map_id
    return msgspec.json.encode(message) + b"\n"


def request_of(line: bytes) -> Request:
    """Decode a client's line; raises `BadRequest`. The heading is brought to [-pi, pi]."""
    try:
        asked = _decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadRequest(f"invalid request: {error}") from None
    code = next((code for code in CommandCode if code.name.lower() == asked.command), None)
    if code is None:
        names = ", ".join(code.name.lower() for code in CommandCode)
        raise BadRequest(f"unknown command {asked.command[:40]!r}; available: {names}")
    pose = asked.x_m, asked.y_m, asked.yaw_rad
    if (code is CommandCode.SET_POSE) != (None not in pose) or pose.count(None) % 3:
        raise BadRequest("x_m, y_m and yaw_rad are needed for set_pose, and allowed only there")
    if (code is CommandCode.SWITCH_MAP) != (asked.map_id is not None):
        raise BadRequest("map_id is needed for switch_map, and allowed only there")
    x, y, yaw = (value or 0.0 for value in pose)
    if not max(abs(x), abs(y)) <= FARTHEST_M or not abs(yaw) <= FARTHEST_M:
        raise BadRequest(f"the pose is beyond {FARTHEST_M:.0f} m or rad")
    if not 0 <= (map_id := asked.map_id or 0) < MAP_IDS:
        raise BadRequest("map_id must be an unsigned number of 32 bits")
    return Request(0, code, (x, y, math.remainder(yaw, 2.0 * math.pi)), map_id)


def reply_line(command: str, outcome: Outcome, reason: str, snapshot: Snapshot | None) -> bytes:
    """Encode the outcome of a command, with the state and the pose of that moment."""
    reply: dict[str, Any] = {"schema": SCHEMA, "command": command, "result": outcome.name.lower(), "reason": reason}
    if snapshot is not None:
        pose = snapshot.pose
        place = None if pose is None else dict(zip(("x_m", "y_m", "yaw_rad"), map(float, pose), strict=True))
        reply |= {"state": snapshot.state.name, "map_id": snapshot.map_id, "pose": place}
    return msgspec.json.encode(reply) + b"\n"
