"""``lumiloop convert``: converts recorded lidar data of other formats to a log for `lumiloop replay`."""

from __future__ import annotations

import argparse

from daemon.replay import convert
from daemon.system import console


def main(args: argparse.Namespace) -> int:
    """Runs the command ``convert``; returns the exit code."""
    delay = convert.DELAY_S if args.delay is None else args.delay
    try:
        scans = convert.convert(args.source, args.log, args.logged, delay, args.all)
    except convert.NotConverted as error:
        return console.fail(str(error))
    for sentence in scans.report.sentences():
        console.say(f"{args.source}: {sentence}")
    console.say(f"{len(scans.stamps)} scans of {scans.ranges.shape[1]} beams into {args.log}")
    return console.OK
