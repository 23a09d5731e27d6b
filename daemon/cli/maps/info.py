"""``lumiloop map info FILE`` and ``lumiloop map verify FILE``: print the content of a map file, and check it.

Both load neither the estimator nor its compiler.
"""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from daemon.config.paths import stored_maps
from daemon.maps.container import MOST_BYTES, BadMap
from daemon.maps.generations import said
from daemon.maps.schema import Stored, read, summary
from daemon.maps.store import Store
from daemon.system import console
from daemon.system.regular_file import read_named

LIST: Final = "{id:<8}  {saved:<23}  {submaps:>7}  {name:<20}  {file}"
"""Columns of the list of maps."""


def folder(args: argparse.Namespace) -> int:
    """Lists the newest file of each map in the configured folder; returns the exit code."""
    if not args.settings.map.kept:
        return console.fail("maps are not stored, because `map.folder` is none; name a file or a folder", console.USAGE)
    return _list(stored_maps(args.settings.map.folder), args.json)


def info(args: argparse.Namespace) -> int:
    """Runs the command for a file or a folder; returns the exit code."""
    if args.map.is_dir():
        return _list(args.map, args.json)
    stored = _read(args.map)
    if isinstance(stored, str):
        return console.fail(stored)
    found = {"file": str(args.map), "bytes": args.map.stat().st_size, **summary(stored)}
    sys.stdout.write(json.dumps(found, indent=2) + "\n" if args.json else _table(found))
    return console.OK


def _list(place: Path, as_json: bool) -> int:
    store = Store(place, mend=False)
    try:
        paths = [one.path for one in store.generations()]
    except OSError as error:
        return console.fail(f"{place}: {said(error)}")
    maps: dict[int, dict[str, Any]] = {}
    bad = False
    for path in paths:
        stored = _read(path)
        if isinstance(stored, str):
            bad = True
            console.say(stored)
        else:
            maps.setdefault(stored.meta.map_id, {"file": str(path), **summary(stored)})
    if as_json:
        sys.stdout.write(json.dumps({"folder": str(place), "maps": list(maps.values())}, indent=2) + "\n")
    elif not maps and not bad:
        sys.stdout.write(f"{place}: no map\n")
    else:
        sys.stdout.write(f"{LIST.format(id='map id', saved='saved', submaps='submaps', name='name', file='file')}\n")
        sys.stdout.writelines(f"{_row(found)}\n" for found in maps.values())
    return console.FAILED if bad else console.OK


def _row(found: dict[str, Any]) -> str:
    number = f"{found['map_id']:08x}"
    return LIST.format(id=number, **{name: found[name] for name in ("submaps", "name", "file")}, saved=_saved(found))


def _saved(found: dict[str, Any]) -> str:
    return f"{datetime.fromtimestamp(found['saved'], UTC):%Y-%m-%d %H:%M:%S} UTC" if found["saved"] else "-"


def verify(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code: 1 if one of the files is not good."""
    bad = 0
    for path in args.maps:
        stored = _read(path)
        if isinstance(stored, str):
            bad += 1
            console.say(stored)
        else:
            torn = f", {stored.isolated} submaps without an edge to the others" if stored.isolated else ""
            sys.stdout.write(f"{path}: valid, map {stored.meta.map_id:08x}{torn}\n")
    return console.FAILED if bad else console.OK


def _read(path: Path) -> Stored | str:
    """Returns the content of a file, or why it cannot be used, with the remedy."""
    try:
        return read(read_named(path, MOST_BYTES))
    except OSError as error:
        return f"{path}: cannot read the map: {said(error)}; name a map file, *.lumimap"
    except BadMap as error:
        return f"{path}: {error}; {error.advice}"


def _table(found: dict[str, Any]) -> str:
    shown = dict(found)
    shown["map_id"] = f"{found['map_id']:08x}"
    shown["saved"] = _saved(found)
    shown["extent_m"] = " x ".join(f"{metres:g}" for metres in found["extent_m"])
    x, y, yaw = found["last_pose"]
    shown["last_pose"] = f"x {x:g} m, y {y:g} m, yaw {yaw:g} rad"
    width = max(map(len, shown)) + 2
    return "".join(f"{key.replace('_', ' '):<{width}}{value}\n" for key, value in shown.items())
