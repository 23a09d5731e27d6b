"""Bodies of `lumiloop set-pose`, `relocalise`, `save-map`, `switch-map`, `pause`, `resume` and `dump`.

Each gives one order, waits for its result, prints it, and ends with 0 only if the order was carried out.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, Final

from daemon.cli.orders.local import NotGiven, give
from daemon.config.schema import Config
from daemon.publish.command_messages import FARTHEST_M, SCHEMA
from daemon.publish.modbus.holding import CommandCode, Request
from daemon.snapshot import GUESSED, State
from daemon.system.console import FAILED, OK, USAGE, fail

POLL_S: Final = 0.2
"""Period at which the end of a search is looked for over Modbus, s."""
DONE: Final = {
    CommandCode.SET_POSE: "pose set",  # whether it is right, the state says
    CommandCode.RESET: "new map started; stored maps remain",
    CommandCode.RELOCALISE: "search ended",
    CommandCode.SAVE_MAP: "map saved and read back",
    CommandCode.SWITCH_MAP: "map switched",
    CommandCode.PAUSE: "paused: the lidar does not correct the pose, and the map does not change",
    CommandCode.RESUME: "pause ended",
    CommandCode.DUMP_RECORDER: "flight recorder content written to the disk",
}
"""Text of an order that was carried out."""
NOT_DONE: Final = {
    "refused": "refused",
    "running": "not finished",
    "replaced": "replaced by a newer command of another client",
    "no result received": "not finished in time; the command continues",
    "unknown": "unknown to this daemon",
}
"""Texts of the other results."""


def main(args: argparse.Namespace) -> int:
    """Runs the command; ``args.code``: the :class:`CommandCode` to give."""
    try:
        request = _request(args)
    except ValueError as error:
        return fail(str(error), USAGE)
    try:
        if args.host is None:
            reply = give(args.settings.name, request, args.timeout)
        else:
            reply = _by_modbus(args.host, args.settings, request, args.timeout)
    except NotGiven as error:
        return fail(str(error))
    done = reply["result"] == "done"
    if args.json:
        sys.stdout.write(json.dumps(reply) + "\n")
    elif done:
        sys.stdout.write(f"{DONE[request.code]}{_state(reply)}\n")
    if done:
        return OK
    reason = f": {reply['reason']}" if reply.get("reason") else ""
    return FAILED if args.json else fail(f"{NOT_DONE.get(reply['result'], reply['result'])}{reason}")


def _request(args: argparse.Namespace) -> Request:
    """The order of the command line; raises ValueError for a pose or a map that cannot be."""
    code: CommandCode = args.code
    if code is CommandCode.SET_POSE:
        if not max(abs(args.x), abs(args.y)) <= FARTHEST_M:
            raise ValueError(f"x and y in m, at most {FARTHEST_M:.0f}")
        return Request(0, code, (args.x, args.y, args.yaw))
    if code is CommandCode.SWITCH_MAP:
        return Request(0, code, (0.0, 0.0, 0.0), map_id_of(args.map))
    return Request(0, code, (0.0, 0.0, 0.0))


def map_id_of(text: str) -> int:
    """The identity of a map: eight hexadecimal digits, or a map file, of which it is read.

    Raises:
        ValueError: neither.
    """
    if text.endswith(".lumimap") or "/" in text:
        return _identity(Path(text))
    try:
        number = int(text, 16)
    except ValueError:
        number = -1
    if not 0 < number < 1 << 32:
        raise ValueError(f"{text}: not a map; give eight hexadecimal digits (`lumiloop map info` lists them) or a file")
    return number


def _identity(path: Path) -> int:
    from daemon.maps.container import MOST_BYTES, BadMap
    from daemon.maps.schema import read
    from daemon.system.regular_file import read_named

    try:
        return read(read_named(path, MOST_BYTES)).meta.map_id
    except (OSError, BadMap) as error:
        raise ValueError(f"{path}: {error}") from None


def _by_modbus(address: str, settings: Config, request: Request, longest_s: float) -> dict[str, Any]:
    """Give an order over Modbus UDP; the reason of a refusal is in the daemon's log only."""
    import asyncio

    from daemon.cli.reports.output import name_of
    from daemon.cli.status import address_of
    from daemon.publish.modbus import command_client
    from daemon.publish.modbus.client import NoAnswer, Reader

    end = time.monotonic() + longest_s
    try:
        host, port = address_of(address, settings)
        result = asyncio.run(command_client.give(host, port, request, None, longest_s))
        with Reader(host, port) as reader:
            reading = reader.read()
            while result == "done" and request.code is CommandCode.RELOCALISE and reading["state"] in GUESSED:
                if time.monotonic() > end:
                    result = "no result received"
                time.sleep(POLL_S)
                reading = reader.read()
    except (NoAnswer, command_client.CommandRefused) as error:
        raise NotGiven(str(error)) from None
    reason = f"the log of the daemon at {host}:{port} gives the cause" if result == "refused" else ""
    reply = {"schema": SCHEMA, "command": request.code.name.lower(), "result": result, "reason": reason}
    names = ("x_m", "map_x"), ("y_m", "map_y"), ("yaw_rad", "map_yaw")
    pose = None if reading["map_x"] is None else {name: reading[register] for name, register in names}
    return reply | {"state": name_of(State, reading["state"]), "map_id": reading["map_id"], "pose": pose}


def _state(reply: dict[str, Any]) -> str:
    """State and pose after the order, as far as the reply contains them."""
    if "state" not in reply:
        return ""
    said = f"; state {reply['state']}"
    if reply["state"] in (state.name for state in GUESSED):
        said += " (the pose is not confirmed yet)"
    if (pose := reply.get("pose")) is not None:
        said += f", x {pose['x_m']:.3f} m, y {pose['y_m']:.3f} m, yaw {math.degrees(pose['yaw_rad']):.2f} deg"
    return said
