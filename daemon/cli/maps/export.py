"""`lumiloop map export SOURCE --out DIR`: exports the map of a log or of a map file for other programs."""

from __future__ import annotations

import argparse
from functools import partial

from daemon.cli import replay
from daemon.maps.grid_files import map_files
from daemon.replay import log_replay
from daemon.replay.results import Folder
from daemon.system import console


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    if args.stored is not None:
        from daemon.cli.maps import convert

        return convert.export(args)
    if args.tum or args.carmen:
        return console.fail(
            f"{args.log}: --tum and --carmen need a map file; `lumiloop replay` writes the trajectory of a log"
        )
    return replay.command(args, partial(_write, args.margin))


def _write(margin_m: float | None, folder: Folder, outcome: log_replay.Outcome) -> None:
    rerun = outcome.rerun
    folder.write_each(map_files(rerun.render(), rerun.ledger.final().poses, rerun.lamps(), margin_m))
