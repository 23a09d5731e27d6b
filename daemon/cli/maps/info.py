"""``lumiloop map info FILE`` and ``lumiloop map verify FILE``: print the content of a map file, and check it.

Both load neither the estimator nor its compiler.
"""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daemon.maps.container import BadMap
from daemon.maps.generations import said
from daemon.maps.schema import Stored, read, summary
from daemon.system import console


def info(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    stored = _read(args.map)
    if isinstance(stored, str):
        return console.fail(stored)
    found = {"file": str(args.map), "bytes": args.map.stat().st_size, **summary(stored)}
    sys.stdout.write(json.dumps(found, indent=2) + "\n" if args.json else _table(found))
    return console.OK


def verify(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code: 1 if one of the files is not good."""
    bad = 0
    for path in args.maps:
        stored = _read(path)
        if isinstance(stored, str):
            bad += 1
            console.say(stored)
        else:
            torn = f", {stored.isolated} submaps joined with the rest by nothing" if stored.isolated else ""
            sys.stdout.write(f"{path}: good, map {stored.meta.map_id:08x}{torn}\n")
    return console.FAILED if bad else console.OK


def _read(path: Path) -> Stored | str:
    """Returns the content of a file, or why it cannot be used, with the remedy."""
    try:
        return read(path.read_bytes())
    except OSError as error:
        return f"{path}: cannot be read: {said(error)}; name a map file, *.lumimap"
    except BadMap as error:
        return f"{path}: {error}; {error.advice}"


def _table(found: dict[str, Any]) -> str:
    shown = dict(found)
    shown["map_id"] = f"{found['map_id']:08x}"
    shown["saved"] = f"{datetime.fromtimestamp(found['saved'], UTC):%Y-%m-%d %H:%M:%S} UTC" if found["saved"] else "-"
    shown["extent_m"] = " x ".join(f"{metres:g}" for metres in found["extent_m"])
    x, y, yaw = found["last_pose"]
    shown["last_pose"] = f"x {x:g} m, y {y:g} m, yaw {yaw:g} rad"
    width = max(map(len, shown)) + 2
    return "".join(f"{key.replace('_', ' '):<{width}}{value}\n" for key, value in shown.items())
