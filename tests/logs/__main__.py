"""``python -m tests.logs [NAME ...]``: replay every log and hold it against its golden poses.

Ends with 1 where one has moved, is not the log that was blessed, or was named and is not there. What is meant is
blessed: ``python -m tests.logs.bless --reason TEXT [NAME ...]``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tests.logs.entries import BY_NAME, ENTRIES, NO_DATA, Entry, asked

if TYPE_CHECKING:  # loaded once it is known what is to be replayed: with it comes the estimator, compiled at first
    from tests.logs import golden


def checked(entry: Entry, root: Path | None) -> golden.Verdict:
    """Replay one."""
    from tests.logs import golden
    from tests.logs.catalog import ledger_of, replayed

    with tempfile.TemporaryDirectory() as folder:
        ledger = ledger_of(replayed(entry, root, Path(folder)))
    try:
        return golden.held(entry.name, ledger, entry.every)
    except golden.Damaged as error:
        return golden.Verdict(False, str(error))


def main(arguments: list[str] | None = None) -> int:
    """The command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.logs", description=__doc__.split("\n")[0])
    parser.add_argument("name", nargs="*", help=f"which logs; default: all of {', '.join(BY_NAME)}")
    parser.add_argument("--all", action="store_true", help="real logs that are not here fail, too")
    args = parser.parse_args(arguments)
    entries, data = asked(parser, args.name)
    from tests.logs import golden
    from tests.logs.catalog import OtherLog

    moved, missing, left = [], [], []
    for entry in entries:
        if entry.source and data is None:
            left.append(entry.name)
            sys.stdout.write(f"{entry.name:<6} not replayed: {NO_DATA}\n")
            continue
        begun = time.monotonic()
        try:
            verdict = checked(entry, data)
        except OtherLog as error:
            missing.append(entry.name)
            sys.stdout.write(f"{entry.name:<6} not replayed: {error}\n")
            continue
        moved += [] if verdict.same else [entry.name]
        said = (
            f"{entry.name:<6} {'same ' if verdict.same else 'MOVED'} {time.monotonic() - begun:5.1f} s  {verdict.said}"
        )
        sys.stdout.write(said + "\n")
        sys.stdout.flush()
    if moved:
        sys.stdout.write(f"look at the change; if it is meant: {golden.REMEDY} {' '.join(moved)}\n")
    if left:
        said = f"{len(left)} of {len(args.name or ENTRIES)} logs not replayed ({', '.join(left)}): {NO_DATA}"
        sys.stdout.write(said + ("\n" if args.name or args.all else "; --all fails without them\n"))
    return int(bool(moved or missing or (left and (args.name or args.all))))


if __name__ == "__main__":
    sys.exit(main())
