"""``lumiloop check``: checks configuration, survey and maps, and looks for the photodiode's bus."""

from __future__ import annotations

import argparse
import sys

from daemon.cli.command_body import find_config
from daemon.cli.reports.output import print_report
from daemon.config import loader
from daemon.config.schema import Config
from daemon.diagnosis.configuration import examine
from daemon.system import console


def main(args: argparse.Namespace) -> int:
    """Runs the command ``check``: lists all defects in one run; returns the exit code.

    A missing bus is a remark, not a defect: files are also checked on other computers.
    """
    args.config = args.file or args.config
    if (file := find_config(args).file) is None:
        return console.fail(
            "no configuration file was found; name one, or make one with `lumiloop config init`", console.USAGE
        )
    wrong, gone = list[tuple[int, str]](), frozenset[str]()
    settings: Config | None
    try:
        settings = loader.load(file, args.set)
    except loader.ConfigError as error:
        settings, gone = error.rest, error.wrong
        wrong.append((console.USAGE, str(error)))
    if args.print_config and settings is not None and not wrong:
        sys.stdout.write(loader.dump(settings))
        return console.OK
    remarks = [] if settings is None else examine(settings, file, gone, wrong)
    code = max((code for code, _ in wrong), default=console.OK)
    if args.json:
        texts = [text for _, text in wrong]
        print_report("check", {"file": str(file), "good": not wrong, "problems": texts, "remarks": remarks})
        return code
    if wrong:
        return console.fail("\n".join(text for _, text in wrong), code)
    sys.stdout.write("".join(f"{line}\n" for line in (f"{file}: good", *remarks)))
    return console.OK
