"""`lumiloop map export SOURCE --out DIR`: exports the map of a log or of a map file for other programs."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from daemon.cli import replay
from daemon.maps.container import MAGIC
from daemon.maps.grid_files import map_files
from daemon.replay import log_replay
from daemon.replay.results import Folder
from daemon.system import console


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    if is_map(args.log):
        from daemon.cli.maps import convert

        return convert.export(args)
    if args.tum or args.carmen:
        return console.fail(
            f"{args.log}: --tum and --carmen are of map files; `lumiloop replay` writes a log's trajectory"
        )
    return replay.command(args, partial(_write, args.margin))


def is_map(path: Path) -> bool:
    """True if the source is a map file; errors of an unreadable file are reported by its reader."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return path.suffix == ".lumimap"


def _write(margin_m: float | None, folder: Folder, outcome: log_replay.Outcome) -> None:
    rerun = outcome.rerun
    folder.write_each(map_files(rerun.render(), rerun.ledger.final().poses, rerun.lamps(), margin_m))
