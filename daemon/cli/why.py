"""`lumiloop why TIME`: replays the flight recorder's data around a moment, and reports state, reason and evidence.

`daemon/diagnosis/recorded_spans.py` finds the recording; `moment_report.py` and `moment_plot.py` there make text and
plot.
"""

from __future__ import annotations

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path

from daemon.cli.reports.output import print_report
from daemon.cli.reports.why import as_object
from daemon.diagnosis import moment_plot, moment_report
from daemon.diagnosis.moment import Moment, chosen
from daemon.diagnosis.moment_replay import moments
from daemon.diagnosis.recorded_spans import whole_second
from daemon.replay.results import Folder, OutputRefused
from daemon.replay.runner import Rerun
from daemon.runtime import warmup
from daemon.system import console
from daemon.system.extras import how_to_install
from hal.errors import HalError


def main(args: argparse.Namespace) -> int:
    """Runs the command; ``args``: the ``time`` as typed, the recording ``found``, plot file (``out``) or None."""
    span, utc, wide = args.found
    try:
        if args.out is not None:
            _try(args.out)
        told, rerun = moments(span, utc)
        second = whole_second(args.time)
        if args.json:
            print_report("why", as_object(told, utc, span.path.name, wide, second) | {"remarks": span.remarks or None})
        else:
            sys.stdout.write(moment_report.report(told, utc, span.path.name, wide, second, span.remarks))
        if rerun.comparison.differ:
            console.say(
                f"the replay differs from the recorded run ({rerun.comparison.first}): the software differs, "
                "or records are lost"
            )
        if args.out is not None:
            _draw(args.out, told, max(utc, told[chosen(told, utc, second, wide).cycle].utc), rerun)
    except (HalError, OutputRefused, warmup.CannotLoad) as error:
        return console.fail(str(error))
    return console.OK


def _try(out: Path) -> None:
    """Checks before the replay that a plot can be made and written; raises `OutputRefused`."""
    if find_spec("matplotlib") is None:
        raise OutputRefused(f"plots need matplotlib: {how_to_install('plot')}")
    Folder(out.parent).demand(out.name)


def _draw(out: Path, told: list[Moment], utc: float, rerun: Rerun) -> None:
    Folder(out.parent).write(out.name, moment_plot.draw(told, utc, rerun.render(), out.suffix[1:].lower()))
