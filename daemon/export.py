"""`lumiloop map export SOURCE --out DIR`: the map of a log or of a map file as other programs read it."""

from __future__ import annotations

import argparse
from pathlib import Path

from daemon import cli, replay
from daemon.results import Folder, map_files
from daemon.store_file import MAGIC


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    if is_map(args.log):
        from daemon import mapfile

        return mapfile.export(args)
    if args.tum or args.carmen:
        return cli.fail(f"{args.log}: --tum and --carmen are of map files; `lumiloop replay` writes a log's trajectory")
    return replay.command(args, _write)


def is_map(path: Path) -> bool:
    """Whether the source is a map file; what cannot be read is left to those who say so."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return path.suffix == ".lumimap"


def _write(folder: Folder, outcome: replay.Outcome) -> None:
    rerun = outcome.rerun
    folder.write_each(map_files(rerun.render(), rerun.ledger.final().poses, rerun.lamps()))
