"""``lumiloop convert``: converts recorded lidar data of other formats to a log for `lumiloop replay`."""

from __future__ import annotations

import argparse
from pathlib import Path

from daemon.replay import convert
from daemon.replay.sources import open_log
from daemon.system import console
from hal.errors import HalError


def main(args: argparse.Namespace) -> int:
    """Runs the command ``convert``; returns the exit code."""
    delay = convert.DELAY_S if args.delay is None else args.delay
    try:
        scans = convert.convert(args.source, args.log, args.logged, delay, args.all)
    except convert.NotConverted as error:
        return console.fail(_replayable(args.source) or str(error))
    for sentence in scans.report.sentences():
        console.say(f"{args.source}: {sentence}")
    console.say(f"{len(scans.stamps)} scans of {scans.ranges.shape[1]} beams written to {args.log}")
    return console.OK


def _replayable(path: Path) -> str:
    """What reads a log that needs no conversion; empty for any other file."""
    try:
        kind = open_log(path).kind
    except HalError:
        return ""
    return f"{path}: a {kind} needs no conversion; use `lumiloop replay`, `lumiloop export` or `lumiloop map export`"
