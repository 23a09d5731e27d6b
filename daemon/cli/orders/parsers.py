"""Parsers of the commands that give an order to a running daemon."""

from __future__ import annotations

import argparse
import math
import re
from typing import Final

from daemon.cli.command_body import config_arguments, later

TIMEOUT_S: Final = 60.0
LONGEST_S: Final = 600.0
"""Default and longest wait for the result, s."""
NEGATIVE: Final = re.compile(r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?(rad|deg)?")
"""What is a number and not an option where a command line has numbers."""

Commands = argparse._SubParsersAction  # what add_subparsers() gives; argparse has no public name for it

SIMPLE: Final = (
    ("relocalise", "RELOCALISE", "search the whole map for the pose, for example after the robot was moved by hand"),
    ("save-map", "SAVE_MAP", "write the map to the disk now"),
    ("reset", "RESET", "forget pose and map, and begin a new map; stored maps remain"),
    ("pause", "PAUSE", "stop using the lidar and changing the map, until `resume`"),
    ("resume", "RESUME", "end a pause"),
    ("dump", "DUMP_RECORDER", "write the content of the flight recorder to the disk"),
)
"""Orders without parameters: command, name of the order, help."""


def add(commands: Commands[argparse.ArgumentParser]) -> None:
    """Adds all these commands."""
    pose = commands.add_parser("set-pose", help="set the robot's pose in the map")
    pose.add_argument("x", type=_metres, metavar="X", help="m, in the map frame")
    pose.add_argument("y", type=_metres, metavar="Y", help="m, in the map frame")
    pose.add_argument("yaw", type=heading, metavar="YAW", help="degrees, counter-clockwise; or radians, as in 1.57rad")
    pose._negative_number_matcher = NEGATIVE  # argparse's own accepts neither units nor exponents
    _order(pose, "SET_POSE")
    switch = commands.add_parser("switch-map", help="switch to another stored map")
    switch.add_argument("map", metavar="MAP", help="eight hexadecimal digits (`lumiloop map info`), or a file")
    _order(switch, "SWITCH_MAP")
    for word, name, text in SIMPLE:
        _order(commands.add_parser(word, help=text), name)


def _order(parser: argparse.ArgumentParser, name: str) -> None:
    parser.add_argument(
        "--host",
        metavar="HOST[:PORT]",
        help="daemon on another computer, over Modbus UDP (needs `modbus.write = true`); default: this computer",
    )
    parser.add_argument(
        "--timeout",
        type=_seconds,
        default=TIMEOUT_S,
        metavar="S",
        help=f"longest wait for the result; default: {TIMEOUT_S:g}",
    )
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    config_arguments(parser)

    body = later("daemon.cli.orders.give", "main")

    def with_code(args: argparse.Namespace) -> int:
        from daemon.publish.modbus.holding import CommandCode

        args.code = CommandCode[name]
        return body(args)

    parser.set_defaults(body=with_code)


def heading(text: str) -> float:
    """A heading in rad: a number of degrees (``90``, ``90deg``), or of radians (``1.57rad``)."""
    number, unit = text, 1.0
    if text.endswith("rad"):
        number = text.removesuffix("rad")
    else:
        number, unit = text.removesuffix("deg"), math.pi / 180.0
    value = _finite(number, text) * unit
    return math.remainder(value, 2.0 * math.pi)


def _metres(text: str) -> float:
    return _finite(text, text)


def _finite(number: str, text: str) -> float:
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return value


def _seconds(text: str) -> float:
    seconds = _finite(text, text)
    if not 0.0 < seconds <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text} s: out of range; give more than 0 and at most {LONGEST_S:g}")
    return seconds
