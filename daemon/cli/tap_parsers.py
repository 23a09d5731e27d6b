"""Parsers of the commands that attach to a running daemon's stream, or need a library of their own.

Most of their bodies are in `taps`, which is loaded only when one of them runs. What they need beyond the core is an
extra of the package; if it is missing, the command names it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from daemon.cli.command_body import Body, config_arguments, estimating, later, listening, loaded, needing
from daemon.system.console import USAGE, fail

Commands = argparse._SubParsersAction  # what add_subparsers() gives; argparse has no public name for it
MOST_DOMAIN = 232
"""Largest ROS domain; the ports of a larger one would be beyond 65535 (DDS)."""


def add(commands: Commands[argparse.ArgumentParser]) -> None:
    """Adds all these commands."""
    _export(commands.add_parser("export", help="write a recording as MCAP (ROS 2, Foxglove), TUM or KITTI"))
    _record_mcap(commands.add_parser("record-mcap", help="record a running daemon as MCAP, until interrupted"))
    _view(commands.add_parser("view", help="show a running daemon or a recording as a web page"))
    _doctor(commands.add_parser("doctor", help="check this installation and name the first thing to fix"))
    _plan(commands.add_parser("plan", help="plan lamps for a hall and compute the resulting accuracy"))
    _metrics(commands.add_parser("metrics", help="serve Prometheus metrics and the VDA 5050 position"))
    _foxglove(commands.add_parser("foxglove", help="serve live data of a running daemon to the Foxglove app"))
    _ros2(
        commands.add_parser(
            "ros2", help="connect a running daemon as a ROS 2 node over Zenoh, without a ROS installation"
        )
    )
    _fleet(commands.add_parser("fleet", help="show all robots on one map; join, share a survey and a map, fetch them"))
    _lamps(commands.add_parser("lamps", help="list defective, dimming and moved lamps, and when to replace them"))
    _demo(commands.add_parser("demo", help="run the daemon on a simulated robot under coded lamps, without hardware"))


def _demo(parser: argparse.ArgumentParser) -> None:
    demo_arguments(parser)
    parser.set_defaults(body=loaded("tools.demo.run", "run"))


def demo_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the demo."""
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--seconds", type=float, default=75.0, help="duration (default %(default)s)")
    length.add_argument(
        "--forever", action="store_const", const=0.0, dest="seconds", help="run until Ctrl-C; records 0.3 GB an hour"
    )
    parser.add_argument("--dark", action="store_true", help="lidar and odometry only, without lamps")
    parser.add_argument("--kidnap", action="store_true", help="move the robot by hand instead of switching sensors off")
    parser.add_argument("--building", default="paper_room", help="building to drive in; default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="seed of noise, slip and people")
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="DIR", help="folder for the results; default: %(default)s"
    )


def _lamps(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--history", type=Path, metavar="FILE", help="history file; default: lamps.csv beside the map folder"
    )
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    listening(parser)
    parser.set_defaults(body=later("daemon.cli.lamps.history", "main"))


def _metrics(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--listen", default="127.0.0.1:9464", metavar="HOST:PORT", help="default: 127.0.0.1:9464")
    listening(parser)
    parser.set_defaults(body=later("taps.metrics.server", "main"))


def _foxglove(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--listen", default="127.0.0.1:8765", metavar="HOST:PORT", help="default: 127.0.0.1:8765")
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="URL",
        help="web app with access, such as https://app.example; Foxglove's own and installed apps always have access",
    )
    listening(parser)
    parser.set_defaults(body=needing("foxglove", "taps.foxglove.live", "main"))


def _ros2(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--domain", type=_domain, default=0, metavar="N", help="ROS_DOMAIN_ID; default: 0")
    parser.add_argument(
        "--namespace", default="", metavar="NAME", help="prefix of every topic, such as /agv1; default: none"
    )
    parser.add_argument("--humble", action="store_true", help="for ROS 2 Humble, whose types have no hash")
    _meeting(parser)
    listening(parser)
    parser.set_defaults(body=needing("zenoh", "taps.ros.node", "main"))


def _fleet(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--watch", action="store_true", help="show until interrupted")
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="image to write")
    _meeting(parser)
    config_arguments(parser)
    parser.set_defaults(body=needing("zenoh", "taps.fleet.show", "main"))
    verbs = parser.add_subparsers(title="verbs", metavar="VERB")
    join = verbs.add_parser("join", help="publish this robot's state to the fleet until stopped")
    join.add_argument("--rate", type=_hertz, default=5.0, metavar="HZ", help="maximum rate of poses; default: 5")
    listening(join)
    join.set_defaults(body=needing("zenoh", "taps.fleet.robot", "main"))
    share = verbs.add_parser("share", help="share a survey, a map, or both, until stopped")
    share.add_argument("--survey", type=Path, metavar="FILE", help="survey for all robots")
    share.add_argument("--map", type=Path, metavar="FILE", help="map file, *.lumimap")
    share.add_argument(
        "--version",
        type=int,
        metavar="N",
        help="version number, larger is newer; default: time of the file's last change, s",
    )
    config_arguments(share)
    share.set_defaults(body=needing("zenoh", "taps.fleet.share", "main"))
    fetch = verbs.add_parser("fetch", help="fetch the shared survey and map, check them and install them")
    fetch.add_argument("what", nargs="*", type=_shared, metavar="survey|map", help="default: both")
    fetch.add_argument("--survey", type=Path, metavar="FILE", help="survey file to write; default: `lights.survey`")
    fetch.add_argument("--switch", action="store_true", help="switch the running daemon to the map (SWITCH_MAP)")
    fetch.add_argument("--follow", action="store_true", help="fetch newer versions too, until stopped")
    config_arguments(fetch)
    fetch.set_defaults(body=needing("zenoh", "taps.fleet.fetch", "main"))
    router = verbs.add_parser("router", help="run the router for all of them, until stopped")
    router.add_argument("--listen", default="127.0.0.1:7447", metavar="HOST:PORT", help="default: 127.0.0.1:7447")
    config_arguments(router)
    router.set_defaults(body=needing("zenoh", "taps.fleet.share", "router"))
    for verb in (join, share, fetch, router):
        _meeting(verb)
        for option in verb._actions:  # argparse has no other way to keep options given before the verb
            if option.dest in ("router", "zenoh", "config", "set", "print_config"):
                option.default = argparse.SUPPRESS


def _meeting(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--router", default="127.0.0.1:7447", metavar="HOST:PORT", help="Zenoh router; default: 127.0.0.1:7447"
    )
    parser.add_argument(
        "--zenoh", type=Path, metavar="FILE", help="Zenoh configuration file: certificates, access rights"
    )


def _shared(text: str) -> str:
    if text not in ("survey", "map"):  # argparse's own `choices` cannot also permit none
        raise argparse.ArgumentTypeError(f"{text}: unknown; give survey or map, or nothing for both")
    return text


def _domain(text: str) -> int:
    number = int(text)
    if not 0 <= number <= MOST_DOMAIN:
        raise argparse.ArgumentTypeError(f"{text}: out of range; ROS 2 has domains 0 to {MOST_DOMAIN}")
    return number


def _hertz(text: str) -> float:
    rate = float(text)
    if not 0.1 <= rate <= 50.0:
        raise argparse.ArgumentTypeError(f"{text} Hz: out of range; give 0.1 to 50")
    return rate


def _megabytes(text: str) -> float:
    size = float(text)
    if not 0.0 <= size < 1e12:
        raise argparse.ArgumentTypeError(f"{text} MB: out of range; give 0 (fill the disk) or more")
    return size


def _port(text: str) -> int:
    number = int(text)
    if not 0 <= number < 1 << 16:
        raise argparse.ArgumentTypeError(f"{text}: not a port; give 1 to 65535, or 0 for any free port")
    return number


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text} s: out of range; give more than 0, or omit it")
    return seconds


def _plan(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP", help="floor plan: map_server's YAML or PGM, or a *.lumimap")
    parser.add_argument(
        "--height", type=float, default=2.5, metavar="M", help="height of the lamps above the ground; 2.5"
    )
    parser.add_argument(
        "--accuracy", type=float, default=0.10, metavar="M", help="required sigma of the light solution; 0.10"
    )
    parser.add_argument("--links", type=int, default=4, metavar="N", help="required lamps in view; 4")
    parser.add_argument(
        "--share", type=float, default=95.0, metavar="PERCENT", help="required share of positions that reach both; 95"
    )
    parser.add_argument(
        "--spacing", type=float, default=0.5, metavar="M", help="spacing of possible lamp positions; 0.5"
    )
    parser.add_argument("--reach", type=float, default=10.0, metavar="M", help="range of the lidar; 10")
    parser.add_argument("--width", type=float, default=0.6, metavar="M", help="width of the robot; 0.6")
    parser.add_argument(
        "--start", type=float, nargs=2, metavar=("X", "Y"), help="start of the robot, m in the map frame"
    )
    parser.add_argument("--lamps", type=int, metavar="N", help="number of lamps, regardless of the goals")
    parser.add_argument(
        "--survey", type=Path, metavar="FILE", help="assess these installed lamps instead, in the map frame"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("plan"), metavar="DIR", help="folder for lights.toml and plan.png; plan"
    )
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    config_arguments(parser)
    parser.set_defaults(body=later("daemon.cli.plan", "main"))


def _doctor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    listening(parser)
    parser.set_defaults(body=loaded("daemon.cli.doctor", "main"))


def _export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="RECORDING", help="recording, dump, or unfinished MCAP file")
    parser.add_argument("--mcap", type=Path, metavar="FILE", help="ROS 2 messages; needs lumiloop[mcap]")
    parser.add_argument("--tum", type=Path, metavar="FILE", help="trajectory: stamp x y z qx qy qz qw")
    parser.add_argument("--kitti", type=Path, metavar="FILE", help="trajectory: 12 matrix elements per line")
    parser.add_argument(
        "--online", action="store_true", help="write trajectories as published, not as corrected at the end"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing MCAP file")
    config_arguments(parser)
    parser.set_defaults(body=_writing(estimating("taps.mcap.export", "main", "log_or_mcap")))


def _writing(body: Body) -> Body:
    def check_and_run(args: argparse.Namespace) -> int:
        if args.mcap is None and args.tum is None and args.kitti is None and not args.print_config:
            return fail("no output is named; give --mcap FILE, --tum FILE or --kitti FILE", USAGE)
        return body(args)

    return check_and_run


def _record_mcap(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="FILE", help="MCAP file to write")
    parser.add_argument("--raw", action="store_true", help="record the bytes between daemon and devices too")
    parser.add_argument("--seconds", type=_seconds, metavar="S", help="stop after this time; default: when interrupted")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument(
        "--reserve", type=_megabytes, default=200.0, metavar="MB", help="stop when less than this is free; default: 200"
    )
    listening(parser)
    parser.set_defaults(body=needing("mcap", "taps.mcap.record", "main"))


def _view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "log", nargs="?", type=Path, metavar="REC", help="a recording or a log; default: the running daemon"
    )
    parser.add_argument(
        "--bind", default="127.0.0.1", metavar="ADDR", help="address of the server; default: %(default)s"
    )
    parser.add_argument("--port", type=_port, default=8090, help="default: %(default)s; 0: any free port")
    parser.add_argument("--write", action="store_true", help="accept commands from clients with the token")
    parser.add_argument(
        "--token", type=Path, metavar="FILE", help="file with the token; default: a new token at each start"
    )
    listening(parser)
    parser.set_defaults(body=needing("view", "taps.view.command", "main"))
