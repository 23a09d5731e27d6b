"""`lumiloop doctor`: runs every check and prints, as text or JSON, what to repair first."""

from __future__ import annotations

import argparse
import json
import sys

from daemon.cli.command_body import find_config
from daemon.config import loader
from daemon.config.paths import stream_path
from daemon.diagnosis.checks import CHECKS, Case, Finding, Level
from daemon.diagnosis.host import Host
from daemon.system import console

_WORDS = {Level.GOOD: "good", Level.REMARK: "note", Level.FIX: "FIX"}


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns 0 if nothing needs repair, 1 otherwise, 2 for a wrong configuration."""
    return examine(args, Host())


def examine(args: argparse.Namespace, host: Host) -> int:
    """Runs the command on a given computer."""
    try:
        settings = loader.load(find_config(args).file, list(args.set))
    except loader.ConfigError as error:
        wrong = Finding(
            "configuration", Level.FIX, str(error), "correct it; the other checks need a valid configuration"
        )
        _tell([wrong], args.json)
        return console.USAGE
    case = Case(settings, args.source.file, host, host.listen(args.stream or stream_path(settings.name)))
    found = [finding for check in CHECKS for finding in check(case)]
    _tell(found, args.json)
    return console.FAILED if any(finding.level is Level.FIX for finding in found) else console.OK


def _tell(found: list[Finding], as_json: bool) -> None:
    if as_json:
        told = [{"about": f.about, "level": f.level.name.lower(), "text": f.text, "remedy": f.remedy} for f in found]
        sys.stdout.write(json.dumps(told, indent=2) + "\n")
        return
    width = max(len(finding.about) for finding in found)
    lines = []
    for finding in found:
        lines.append(f"{_WORDS[finding.level]:<5}{finding.about:<{width + 2}}{finding.text}")
        if finding.remedy:
            lines.append(f"{'':<{width + 7}}-> {finding.remedy}")
    first = next((finding for finding in found if finding.level is Level.FIX), None)
    count = sum(finding.level is Level.FIX for finding in found)
    if first is None:
        lines.append("no problem was found")
    else:
        lines.append(f"{count} to fix. Fix first: {first.about}: {first.remedy}")
    sys.stdout.write("\n".join(lines) + "\n")
