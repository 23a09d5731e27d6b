"""``lumiloop map align|name``: moves a map to given points, or sets its name."""

from __future__ import annotations

import argparse
import math
import secrets
import sys

import msgspec

from daemon.maps.container import BadMap
from daemon.maps.edit import Refused, called, fitted, judge, moved, opened, pair_of, written
from daemon.system import console


def align(args: argparse.Namespace) -> int:
    """Moves a map so that its points lie at the given positions; returns the exit code."""
    try:
        stored = opened(args.map)
        if stored.meta.surveyed:
            raise Refused(
                f"{args.map}: the map is in the frame of the lamp survey; move the lamps in the survey instead"
            )
        fit = fitted([pair_of(text) for text in args.point])
        judge(fit)
        meta = msgspec.structs.replace(stored.meta, map_id=1 + secrets.randbelow(2**32 - 1))
        path = written(args.map, args.out, moved(stored.tables, fit.T), meta)
    except (BadMap, Refused, OSError) as error:
        return console.fail(str(error))
    x, y, yaw = fit.T
    off = ", ".join(f"{1e3 * one:.0f} mm" for one in fit.residual_m)
    sys.stdout.write(
        f"map moved by x {x:.3f} m, y {y:.3f} m, yaw {math.degrees(yaw):.2f} deg. Residuals of the points: "
        f"{off}. Distances are {100.0 * (fit.scale - 1.0):+.2f} % of the map's\n{path}: map "
        f"{meta.map_id:08x}\n"
    )
    return console.OK


def name(args: argparse.Namespace) -> int:
    """Sets the name of the floor or building of a map; returns the exit code."""
    try:
        stored = opened(args.map)
        meta = msgspec.structs.replace(stored.meta, name=called(args.text))
        path = written(args.map, args.out, stored.tables, meta)
    except (BadMap, Refused, OSError) as error:
        return console.fail(str(error))
    sys.stdout.write(f"{path}: map {meta.map_id:08x} is now named {meta.name!r}\n")
    return console.OK
