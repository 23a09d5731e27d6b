"""Parser of the command line. Each command's body is imported only when it runs, so that small commands stay small.

Exit codes: 0 done, 1 failed (the text gives cause and remedy), 2 wrong usage or configuration, 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from daemon.cli import tap_parsers
from daemon.cli.command_body import Body, config_arguments, estimating, later, loaded
from daemon.cli.config import parsers as config_parsers
from daemon.cli.manual import verbs as manual
from daemon.cli.manual.command_parser import CommandParser, finish, overview
from daemon.cli.orders import parsers as order_parsers
from daemon.system import console
from daemon.system.console import INTERRUPTED, OK, USAGE, fail
from estimator.paper import LUMILOOP, METHODS

Commands = argparse._SubParsersAction  # what add_subparsers() gives; argparse has no public name for it
LONGEST_RING: Final = 1440.0
"""Longest ring, minutes; a longer recording is kept whole."""
PICTURES: Final = (".png", ".svg", ".pdf")
"""Suffixes of image files that can be written."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code. Wrong usage raises SystemExit(2) after an explanation."""
    try:
        words = parser()
        args = words.parse_args(argv)
        level = getattr(args, "log_level", None)
        console.be_quiet(level == "error")
        if level is not None:
            _set_level(level)
        body: Body | None = getattr(args, "body", None)
        if body is None:
            words.print_help(sys.stderr)
            return USAGE
        return body(args)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has closed it
        return OK


def _set_level(level: str) -> None:
    from daemon.system.logging import set_level

    set_level(level)


class _Program(CommandParser):
    """Parser of the program, whose help is an overview."""

    def format_help(self) -> str:
        return overview(self.description or "")


def parser() -> argparse.ArgumentParser:
    """Returns the parser of every command; ``body`` of its result is the :data:`Body` to run."""
    parser = _Program(
        prog="lumiloop",
        description="Indoor robot localisation from a 2D lidar and coded ceiling lights.\nIt publishes a pose "
        "over Modbus and UDP. It is not a safety function.",
    )
    _print_option(parser, "--version", _version, "the version")
    _print_option(parser, "--schema", _schema, "print the JSON schema of the configuration")
    _print_option(parser, "--reference", _reference, "print the reference of the configuration (Markdown)")
    _print_option(parser, "--print-config", _defaults, "print every key of the configuration with its default")
    commands: Commands[argparse.ArgumentParser] = parser.add_subparsers(
        title="commands", metavar="COMMAND", dest="command", parser_class=CommandParser
    )
    _run(commands.add_parser("run", help="read the sensors and publish the pose until stopped"))
    _check(commands.add_parser("check", help="check a configuration file and its survey"))
    config_parsers.add(commands)
    _probe(commands.add_parser("probe", help="find and identify lidars and photodiode converters"))
    _replay(commands.add_parser("replay", help="run a log through the same pipeline, as fast as possible"))
    _convert(commands.add_parser("convert", help="convert recorded lidar data of other formats to a log for replay"))
    _why(commands.add_parser("why", help="replay a recorded instant and explain its state"))
    _status(commands.add_parser("status", help="show the values that a running daemon publishes"))
    _explain(commands.add_parser("explain", help="explain a key, state, fault, reason or register"))
    _map(commands.add_parser("map", help="work with maps"))
    _calibrate(
        commands.add_parser(
            "calibrate", help="calibrate lamps, receiver, odometry or lidar mount from a recorded drive"
        )
    )
    _survey(commands.add_parser("survey", help="locate the lamps from a recorded drive"))
    _warm(commands.add_parser("warm", help="compile the kernels now instead of at the first start"))
    _codes(commands.add_parser("codes", help="print the code tables for building lamps"))
    order_parsers.add(commands)
    tap_parsers.add(commands)
    manual.add(commands, parser, _version)
    finish(parser)
    return parser


def _print_option(parser: argparse.ArgumentParser, flag: str, text: Callable[[], str], what: str) -> None:
    def body(args: argparse.Namespace) -> int:
        sys.stdout.write(text())
        return OK

    parser.add_argument(flag, action="store_const", const=body, dest="body", help=f"print {what}")


def _run(parser: argparse.ArgumentParser) -> None:
    config_arguments(parser)
    parser.add_argument("--lidar", metavar="DEVICE", help="same as --set lidar.device=DEVICE")
    parser.add_argument("--record", type=Path, metavar="DIR", help="record raw bytes and cycles into this directory")
    parser.add_argument(
        "--last",
        type=_minutes,
        metavar="MINUTES",
        help="record in a ring of this length; a fault or a command makes a dump",
    )
    parser.set_defaults(body=_recording(later("daemon.cli.run", "main")))


def _minutes(text: str) -> float:
    try:
        minutes = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of minutes; give 1 to {LONGEST_RING:.0f}") from None
    if not 1.0 <= minutes <= LONGEST_RING:
        raise argparse.ArgumentTypeError(f"{text} minutes: out of range; give 1 to {LONGEST_RING:.0f}")
    return minutes


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(
            f"{text}: unknown image format; use a name that ends with {', '.join(PICTURES)}"
        )
    return path


def _recording(body: Body) -> Body:
    def check_and_run(args: argparse.Namespace) -> int:
        if args.last is not None and args.record is None:
            return fail("--last needs --record; name a directory with --record DIR", USAGE)
        return body(args)

    return check_and_run


def _check(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", nargs="?", type=Path, metavar="FILE", help="configuration file (TOML); the same as --config FILE"
    )
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    config_arguments(parser)
    parser.set_defaults(body=loaded("daemon.cli.check", "main"))  # it resolves the configuration itself


def _probe(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("devices", nargs="*", metavar="DEVICE", help="device to probe; default: all possible devices")
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    config_arguments(parser)
    parser.set_defaults(body=later("daemon.cli.probe", "main"))


def _replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="CARMEN log (.gz too), or a recording's directory")
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="directory for the results")
    parser.add_argument(
        "--journal", metavar="N[,N..]", help="write these matches in full: numbers from 1, or: failed, or: failed,5"
    )
    parser.add_argument(
        "--journal-at", type=float, metavar="SECONDS", help="and the first match at this time after the start"
    )
    known = "; ".join(f"{name}: {what}" for name, what in METHODS.items())
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    parser.add_argument("--method", choices=METHODS, default=LUMILOOP, help=f"{known}; default: {LUMILOOP}")
    _margin(parser)
    config_arguments(parser)
    parser.set_defaults(body=estimating("daemon.cli.replay", "main", "log"))


def _convert(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, metavar="IN", help="a .dat (.gz) or .npz file; see docs/data.md")
    parser.add_argument("log", type=Path, metavar="OUT", help="the log to write, .log or .log.gz")
    parser.add_argument("--logged", action="store_true", help="keep the host's stamps instead of evenly spaced ones")
    parser.add_argument("--delay", type=float, metavar="S", help="from the first beam to mean arrival (default 0.12)")
    parser.add_argument("--all", action="store_true", help="keep beams that hit the rover, and ranges beyond 4 m")
    parser.set_defaults(body=loaded("daemon.cli.convert", "main"))


def _why(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("time", metavar="TIME", help="21:14:07, 2026-11-21T21:14:07Z, or seconds since the start")
    parser.add_argument(
        "log",
        nargs="?",
        type=Path,
        metavar="REC",
        help="a recording or a dump, or a folder of several; default: `flight` in the state directory",
    )
    parser.add_argument("--out", type=_picture, metavar="FILE", help="plot to write: .png, .svg or .pdf")
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    config_arguments(parser)
    parser.set_defaults(body=estimating("daemon.cli.why", "main", "moment"))


def _status(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("address", nargs="?", metavar="HOST[:PORT]", help="default: the configuration's Modbus server")
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    parser.add_argument("--watch", action="store_true", help="show continuously; arrows, space and b scroll, q quits")
    config_arguments(parser)
    parser.set_defaults(body=later("daemon.cli.status", "main"))


def _explain(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "words", nargs="+", metavar="WORD", help="for example: alert_m, DEGRADED, fault 302, map_yaw, 1008"
    )
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    parser.set_defaults(body=loaded("daemon.cli.explain", "main"))


def _map(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    export = verbs.add_parser("export", help="write a map in formats of other programs")
    export.add_argument("log", type=Path, metavar="SOURCE", help="a map file, *.lumimap; or a log or a recording")
    export.add_argument("--out", type=Path, metavar="DIR", required=True, help="directory for the files")
    export.add_argument("--pgm", action="store_true", help="map.pgm, map.yaml, map.png; default")
    export.add_argument("--tum", action="store_true", help="keyframes.tum: poses of the keyframes of a map file")
    export.add_argument("--carmen", action="store_true", help="keyframes.clf: poses and scans of the keyframes")
    _margin(export)
    config_arguments(export)
    export.set_defaults(body=estimating("daemon.cli.maps.export", "main", "log_or_map"))
    taken = verbs.add_parser("import", help="convert a map from map_server or Nav2 for localisation")
    taken.add_argument("yaml", type=Path, metavar="YAML", help="YAML description, with its image beside it")
    taken.add_argument("--name", metavar="TEXT", help="name of the storey or building; default: the file's name")
    taken.add_argument(
        "--out", type=Path, metavar="FILE", help="default: the configured map folder, which the next start reads"
    )
    config_arguments(taken)
    taken.set_defaults(body=estimating("daemon.cli.maps.convert", "take_in", "map_server", "warm-plan"))
    render = verbs.add_parser("render", help="draw a map file as an image")
    render.add_argument("map", type=Path, metavar="FILE", help="map file, *.lumimap")
    render.add_argument("out", type=Path, metavar="PNG", help="image to write")
    _margin(render)
    config_arguments(render)
    render.set_defaults(body=estimating("daemon.cli.maps.convert", "render", "map_file", "warm-plan"))
    _map_changes(verbs)
    info = verbs.add_parser("info", help="print the content of a map file")
    info.add_argument(
        "map", type=Path, nargs="?", metavar="FILE", help="map file, or a folder; default: list the configured folder"
    )
    info.add_argument("--json", action="store_true", help="machine-readable output")
    config_arguments(info)
    info.set_defaults(body=_map_info)
    verify = verbs.add_parser("verify", help="check that map files are complete and consistent")
    verify.add_argument("maps", type=Path, nargs="+", metavar="FILE", help="map files, *.lumimap")
    verify.set_defaults(body=loaded("daemon.cli.maps.info", "verify"))


def _map_info(args: argparse.Namespace) -> int:
    """A named file or folder needs no configuration."""
    module = "daemon.cli.maps.info"
    return (later(module, "folder") if args.map is None or args.print_config else loaded(module, "info"))(args)


def _margin(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--margin", type=_metres, metavar="M", help="draw only this distance around the path of the robot; default: all"
    )


def _metres(text: str) -> float:
    metres = float(text)
    if not 0.0 < metres < 1e6:
        raise argparse.ArgumentTypeError(f"{text} m: out of range; give more than 0")
    return metres


def _map_changes(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    align = verbs.add_parser("align", help="move a map so that given points have given coordinates")
    align.add_argument("map", type=Path, metavar="FILE", help="map file, *.lumimap")
    align.add_argument(
        "--point",
        action="append",
        default=[],
        metavar="X,Y=X',Y'",
        help="two or more points, from and to, in m; --point=-1,0=0,0 if the first number is negative",
    )
    name = verbs.add_parser("name", help="set the name of a map, for example of a storey or building")
    name.add_argument("map", type=Path, metavar="FILE", help="map file, *.lumimap")
    name.add_argument("text", metavar="NAME", help="at most 64 characters")
    for parser, verb in ((align, "align"), (name, "name")):
        parser.add_argument(
            "--out",
            type=Path,
            metavar="FILE",
            help="default: newest map beside FILE; stop the daemon there first",
        )
        parser.set_defaults(body=loaded("daemon.cli.maps.edit", verb))


def _calibrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="REC", help="recording of a teach drive (lumiloop run --record)")
    parser.add_argument("--survey", type=Path, metavar="FILE", help="survey to start from; default: the recording's")
    parser.add_argument(
        "--start", type=float, nargs=3, metavar=("X", "Y", "DEG"), help="start pose of the drive in the survey"
    )
    parser.add_argument("--odometry", action="store_true", help="calibrate wheel scale and track instead of lamps")
    parser.add_argument("--lidar-mount", action="store_true", help="calibrate the lidar mount instead of lamps")
    other = "with --odometry or --lidar-mount a configuration, lumiloop-calibrated.toml"
    _written(parser, f"survey to write, default lights-calibrated.toml; {other}")
    parser.set_defaults(body=estimating("daemon.cli.calibrate", "main", "log", "warm-teach"))


def _survey(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="REC", help="recording of a drive under the lamps")
    parser.add_argument(
        "--height", type=float, metavar="M", help="height of the lamps above the ground; default: estimated"
    )
    _written(parser, "survey to write; default: lights.toml", Path("lights.toml"))
    parser.set_defaults(body=estimating("daemon.cli.survey", "main", "log", "warm-teach"))


def _written(parser: argparse.ArgumentParser, what: str, default: Path | None = None) -> None:
    parser.add_argument("--out", type=Path, metavar="FILE", default=default, help=what)
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    config_arguments(parser)


def _warm(parser: argparse.ArgumentParser) -> None:
    config_arguments(parser)
    parser.set_defaults(body=later("daemon.cli.warm", "main"))


def _codes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--profile", choices=("A", "B", "D"), default="A", help="air interface; default: A")
    parser.add_argument("--code", type=int, metavar="N", help="print only this code; default: all")
    parser.add_argument("--format", choices=("c", "csv", "json"), default="csv", help="default: csv")
    parser.set_defaults(body=loaded("daemon.cli.lamps.codes", "main"))


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"lumiloop {version('lumiloop')}\n"
    except PackageNotFoundError:
        return "lumiloop, run from its source tree without being installed\n"


def _schema() -> str:
    from daemon.config.loader import schema

    return schema()


def _reference() -> str:
    from daemon.config.loader import reference

    return reference()


def _defaults() -> str:
    from daemon.config.loader import dump, load

    return dump(load(None))
