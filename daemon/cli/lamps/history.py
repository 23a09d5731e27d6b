"""`lumiloop lamps`: collects the lamps' gain history from the maps and lists the lamps that need service."""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from daemon.config.paths import stored_maps, stream_path
from daemon.config.schema import Config
from daemon.diagnosis.host import Heard, Host, standing
from daemon.diagnosis.lamp_history import BadHistory, by_lamp, in_maps, load, merged, save
from daemon.diagnosis.lamp_trend import Verdict, judge, together
from daemon.system import console

FILE: Final = "lamps.csv"
TOGETHER: Final = -0.02
"""Relative change a year, common to all lamps, below which it is reported."""


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns 0 if no lamp is urgent, 1 otherwise."""
    return tell(args, Host())


def tell(args: argparse.Namespace, host: Host) -> int:
    """Runs the command on a given computer."""
    settings: Config = args.settings
    if not settings.map.kept and args.history is None:
        return console.fail(
            "no lamp history is available, because maps are not stored (`map.folder` is none)", console.USAGE
        )
    maps = stored_maps(settings.map.folder) if settings.map.kept else None
    path: Path = args.history or (maps.parent / FILE if maps is not None else Path(FILE))
    if args.history is not None and not path.parent.is_dir():
        return console.fail(
            f"--history {path}: no such folder: {path.parent}; make it, or name another file", console.USAGE
        )
    try:
        kept = load(path)
        fresh = in_maps(maps) if maps is not None else []
        looks = merged(kept, fresh)
        if looks != kept:
            save(path, looks)
    except BadHistory as error:
        return console.fail(str(error))
    except OSError as error:
        return console.fail(
            f"{error.filename or path}: {error.strerror}; run this as the daemon's user, or name a file with "
            "--history FILE"
        )
    heard = host.listen(args.stream or stream_path(settings.name))
    verdicts = judge(by_lamp(looks), host.utc(), _said_of(heard) if isinstance(heard, Heard) else {})
    if not verdicts:
        return console.fail("the history has no lamp yet; drive under surveyed lamps until the map is saved")
    if not isinstance(heard, Heard):
        why = heard if isinstance(heard, str) else heard.text
        console.say(f"no daemon reports which lamps are defective or moved at present: {why}")
    sys.stdout.write(_as_json(verdicts) if args.json else _table(verdicts))
    return console.FAILED if any(one.urgent for one in verdicts) else console.OK


def _said_of(heard: Heard) -> dict[int, int]:
    """Returns the daemon's use of each lamp; dead or moved only with the fault, since a passing shadow is neither."""
    lasts = standing(heard)
    return {lamp: use for (_, lamp), use in heard.lamps.items() if lamp is not None and lasts(use)}


def _table(verdicts: list[Verdict]) -> str:
    lines = [f"{'lamp':>6}  {'level':>6}  {'a year':>14}  {'replace by':<24}what"]
    for one in verdicts:
        trend = "-" if one.per_year is None else f"{100 * one.per_year:+.1f} +- {100 * one.sigma:.1f} %"
        when = "-" if one.replace_by is None else f"{_day(one.replace_by)} ({_day(one.earliest)})"
        since = "" if one.since is None else f", since {_day(one.since)}"
        lines.append(f"{one.lamp:>6}  {100 * one.level:>4.0f} %  {trend:>14}  {when:<24}{one.finding.value}{since}")
    common = together(verdicts)
    if common is not None and common < TOGETHER:
        lines.append(f"all lamps together: {100 * common:+.1f} % a year: clean the receiver's window first")
    urgent = [str(one.lamp) for one in verdicts if one.urgent]
    lines.append(f"needs attention: lamp {', '.join(urgent)}" if urgent else "no lamp is urgent")
    return "".join(f"{line}\n" for line in lines)


def _as_json(verdicts: list[Verdict]) -> str:
    told = [
        {
            "lamp": one.lamp,
            "finding": one.finding.name.lower(),
            "urgent": one.urgent,
            "level": round(one.level, 4),
            "per_year": one.per_year,
            "sigma": one.sigma,
            "replace_by": one.replace_by,
            "earliest": one.earliest,
            "since": one.since,
        }
        for one in verdicts
    ]
    return json.dumps(told, indent=2) + "\n"


def _day(utc: float | None) -> str:
    return "-" if utc is None else f"{datetime.fromtimestamp(utc, UTC):%Y-%m-%d}"
