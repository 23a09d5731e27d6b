"""`lumiloop replay LOG --out DIR`: replays a log through the daemon's own pipeline and writes the results as files.

Two replays of one log write identical bytes; measured durations are separate, in ``timing.json``. If an unreadable part
of the log or the user stops a replay early, the results until then are written.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from daemon.replay.log_replay import Outcome, replay
from daemon.replay.recorded_inputs import Given
from daemon.replay.report import write_all
from daemon.replay.results import Folder, OutputRefused, doubt, guessed
from daemon.runtime import warmup
from daemon.system import console
from estimator.paper import LUMILOOP
from hal.errors import HalError

if TYPE_CHECKING:  # loaded only if matches are requested
    from daemon.replay.match_journal import MatchJournal


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    journal = None
    if args.journal is not None or args.journal_at is not None:
        from daemon.replay import match_journal

        try:
            journal = match_journal.MatchJournal(match_journal.choice_of(args.journal, args.journal_at))
        except match_journal.BadChoice as error:
            return console.fail(str(error), console.USAGE)
    write = partial(_write_and_print if args.json else write_all, margin_m=args.margin)
    return command(args, write, journal, args.method)


def _write_and_print(folder: Folder, outcome: Outcome, margin_m: float | None) -> None:
    """Writes every result, and prints the summary on stdout."""
    write_all(folder, outcome, margin_m=margin_m)
    sys.stdout.write((folder.path / "summary.json").read_text())


def command(
    args: argparse.Namespace,
    write: Callable[[Folder, Outcome], None],
    journal: MatchJournal | None = None,
    method: str = LUMILOOP,
) -> int:
    """Replays ``args.source``, lets ``write`` put results into ``args.out``, reports, and returns the exit code."""
    try:
        folder = Folder(args.out)
        keys = tuple(override.partition("=")[0].strip() for override in args.set)
        outcome = replay(args.source, args.settings, Given(args.config is not None, keys), journal, method)
        write(folder, outcome)
    except (HalError, OutputRefused, warmup.CannotLoad) as error:
        return console.fail(str(error))
    if outcome.stopped:
        return console.fail(f"{outcome.stopped}; the results up to there are in {folder.path}", _code(outcome))
    return _verdict(outcome)


def _code(outcome: Outcome) -> int:
    return console.INTERRUPTED if outcome.stopped == "interrupted" else console.FAILED


def _verdict(outcome: Outcome) -> int:
    """Prints the summary on stderr and returns the exit code: a replay without a pose has failed."""
    source, rerun = outcome.source, outcome.rerun
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    for sentence in source.report.sentences():
        sys.stderr.write(f"replay: {source.path}: {sentence}\n")
    for sentence in () if outcome.journal is None else outcome.journal.sentences():
        sys.stderr.write(f"replay: {sentence}\n")
    if not len(rerun.ledger):
        sources = "a scan or light" if rerun.blocks else "a scan"
        return console.fail(f"{source.path}: {source.kind} does not contain {sources} that gave a pose")
    if rerun.comparison.differ:
        first = rerun.comparison.first
        sys.stderr.write(f"replay: {rerun.comparison.differ} cycles differ from the recorded run; {first}\n")
    if outcome.journal is not None and outcome.journal.missed():
        return console.fail("the log has none of the requested matches; the other results are written")
    log_s, run_s = rerun.t_mono - rerun.t_first, outcome.seconds["run"]
    speed = f"{log_s:.1f} s of log in {run_s:.1f} s ({log_s / run_s:.0f} x real time)"
    online = rerun.ledger.online()
    for sentence in filter(None, (f"{len(rerun.ledger)} poses, {speed}", guessed(online), doubt(online))):
        sys.stderr.write(f"replay: {sentence}\n")
    return console.OK
