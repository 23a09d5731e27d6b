"""`lumiloop map export LOG --out DIR`: the map alone, as map_server reads it and as a picture."""

from __future__ import annotations

import argparse

from daemon import replay
from daemon.results import Folder, map_files


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    return replay.command(args, _write)


def _write(folder: Folder, outcome: replay.Outcome) -> None:
    rerun = outcome.rerun
    folder.write_each(map_files(rerun.render(), rerun.ledger.final().poses, rerun.lamps()))
