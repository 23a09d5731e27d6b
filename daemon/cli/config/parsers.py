"""Parsers of ``lumiloop config init``, ``show`` and ``set``."""

from __future__ import annotations

import argparse
from pathlib import Path

from daemon.cli.command_body import config_arguments, loaded

Commands = argparse._SubParsersAction  # what add_subparsers() gives; argparse has no public name for it


def add(commands: Commands[argparse.ArgumentParser]) -> None:
    """Adds the command with its verbs."""
    parser = commands.add_parser("config", help="make, show or change a configuration file")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    init = verbs.add_parser("init", help="write a file with every key as a comment")
    init.add_argument(
        "file", nargs="?", type=Path, default=Path("lumiloop.toml"), metavar="FILE", help="default: %(default)s"
    )
    init.add_argument("--force", action="store_true", help="replace an existing file")
    init.set_defaults(body=loaded("daemon.cli.config.verbs", "init"))
    show = verbs.add_parser("show", help="print the file in use and all resulting values")
    config_arguments(show)
    show.set_defaults(body=loaded("daemon.cli.config.verbs", "show"))
    change = verbs.add_parser("set", help="change values in the file and keep its comments")
    change.add_argument("values", nargs="+", metavar="KEY=VALUE", help="as in modbus.port=502")
    change.add_argument("--config", type=Path, metavar="FILE", help="configuration file; default: the first found")
    change.set_defaults(body=loaded("daemon.cli.config.verbs", "change"))
