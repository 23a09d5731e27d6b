"""Loading of command bodies: imports a command's module when it runs, with the configuration resolved.

Options that several commands share are here, too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from daemon.system.console import OK, USAGE, fail, note
from daemon.system.extras import how_to_install
from daemon.system.logging import start_command_log

if TYPE_CHECKING:
    from daemon.config.discovery import Source

OURS = ("daemon", "estimator", "hal", "taps")

Body = Callable[[argparse.Namespace], int]
"""Runs a command and returns the exit code."""


def config_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of every command that reads the configuration; see :func:`configured`."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="configuration file; default: the first found (config show)"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override one key")
    parser.add_argument("--print-config", action="store_true", help="print the resolved configuration and stop")


def later(module: str, name: str) -> Body:
    """Returns a body that resolves the configuration (``args.settings``, a `Config`) and then loads its module."""
    return configured(loaded(module, name))


def estimating(module: str, name: str, opens: str, what: str = "warm") -> Body:
    """Like `later`, for a module that imports ``what`` of the estimator: announces a compilation of about a minute.

    ``opens``: function of `daemon.cli.inputs` that opens and judges the command's input before that.
    """

    def body(args: argparse.Namespace) -> int:
        from daemon.cli import inputs
        from daemon.runtime import warmup

        try:
            getattr(inputs, opens)(args)
        except inputs.REFUSALS as error:
            return fail(str(error))
        try:
            warmup.load_aloud(note, what, warmup.load, module)
        except warmup.CannotLoad as error:
            return fail(str(error))
        return loaded(module, name)(args)

    return configured(body)


def loaded(module: str, name: str) -> Body:
    """Returns a body that loads its module when it runs. What serves clients (`taps`) has a limit of tracebacks."""

    def body(args: argparse.Namespace) -> int:
        if module.startswith("taps."):
            from daemon.system.traceback_limit import limit_tracebacks

            limit_tracebacks()
        run: Body = getattr(import_module(module), name)
        return run(args)

    return body


def find_config(args: argparse.Namespace) -> Source:
    """Finds the configuration file of a command and keeps it as ``args.source``; says which, if nobody has named it."""
    from daemon.config import discovery

    source = args.source = discovery.find(args.config)
    if source.file is not None and not source.named:
        note(f"configuration {source}")
    return source


def configured(body: Body) -> Body:
    """Returns a body that runs with the resolved configuration as ``args.settings``, and its file as ``args.source``.

    ``args.config`` stays what the command line names: a recording is replayed under another configuration only if the
    user asks for that.
    """

    def resolve_and_run(args: argparse.Namespace) -> int:
        from daemon.config import loader

        overrides = list(args.set)
        if getattr(args, "lidar", None):
            overrides.append(f"lidar.device={args.lidar}")
        try:
            args.settings = loader.load(find_config(args).file, overrides)
        except loader.ConfigError as error:
            return fail(str(error), USAGE)
        if args.print_config:
            sys.stdout.write(loader.dump(args.settings))
            return OK
        return body(args)

    return resolve_and_run


def listening(parser: argparse.ArgumentParser) -> None:
    """Adds the options that select a running daemon; ``args.stream``: Path, or None for the configuration's stream."""
    parser.add_argument(
        "--stream", type=Path, metavar="SOCKET", help="the daemon's local stream; default: that of the configured name"
    )
    config_arguments(parser)


def needing(extra: str, module: str, name: str) -> Body:
    """Returns a body that resolves the configuration and loads its module, which needs an extra of the package."""

    def body(args: argparse.Namespace) -> int:
        try:
            import_module(module)
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing in OURS:
                raise
            return fail(f"this command needs {missing}, which is not installed: {how_to_install(extra)}")
        start_command_log()
        return loaded(module, name)(args)

    return configured(body)
