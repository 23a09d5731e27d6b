"""``python -m tests.logs.bless --reason TEXT [NAME ...]``: make today's trajectories the golden ones.

Prints by how much each differs from the one before. Commit the files together with the change that moved them.
``--here`` instead of a reason keeps them as this machine's own reference (``out/golden``), for a change to be held
against to the micrometre on a machine that the committed ones are not of.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from tests.logs.entries import BY_NAME, NO_DATA, Entry, asked

if TYPE_CHECKING:
    from daemon.replay.results import Trajectory
    from estimator.result import Loop
    from tests.logs import golden


def bless(entry: Entry, root: Path | None, reason: str, into: Path | None = None) -> str:
    """Write one log's golden files, or this machine's own ``into`` a folder; returns what changed, for people."""
    from tests.logs import golden
    from tests.logs.catalog import ledger_of, replayed

    with tempfile.TemporaryDirectory() as folder:
        ledger = ledger_of(replayed(entry, root, Path(folder)))
    loops = [loop for _, loop in ledger.loops]
    told = golden.both(entry.name, ledger)
    return "\n".join(_bless(name, entry, trajectory, loops, reason, into) for name, trajectory in told.items())


def _bless(name: str, entry: Entry, trajectory: Trajectory, loops: list[Loop], reason: str, into: Path | None) -> str:
    """Write one file; what changed."""
    from tests.logs import golden
    from tests.logs.catalog import origin

    moved = "new"
    if ((into or golden.FOLDER) / f"{name}.txt").exists():
        try:
            moved = _moved(golden.load(name, into), entry, trajectory, loops)
        except golden.Damaged as error:
            moved = f"new, what was there is damaged: {error}"
        if not moved:
            return f"{name}: unchanged"
    facts = golden.facts_of(trajectory, loops, origin(entry), reason)
    path = golden.save(name, trajectory, entry.every, facts, into)
    return f"{name}: {moved}; {path}"


def _moved(old: golden.Golden, entry: Entry, trajectory: Trajectory, loops: list[Loop]) -> str:
    """By how much; empty where the file may stay as it is, to the last digit."""
    from tests.logs import golden

    if old.facts["digest"] == golden.digest(trajectory) and golden.judged(old, trajectory, loops, entry.every).same:
        return ""
    far = golden.largest_difference(old, trajectory, entry.every)
    step = golden.largest_difference(old, trajectory, entry.every, motion=True)
    return f"moved by up to {far:.6f} m, from one kept pose to the next by up to {step:.6f} m"


def main() -> int:
    """The command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.logs.bless", description=__doc__.split("\n")[0])
    why = parser.add_mutually_exclusive_group(required=True)
    why.add_argument("--reason", help="why the trajectories have changed; kept in the files")
    why.add_argument(
        "--here", action="store_true", help="keep them as this machine's own reference, not to be committed"
    )
    parser.add_argument("name", nargs="*", help=f"which logs; default: all of {', '.join(BY_NAME)}")
    args = parser.parse_args()
    reason = "reference of this machine" if args.here else args.reason
    if len(reason.strip()) <= 10:
        parser.error(f"--reason {args.reason!r} says nothing to whoever reads the file in a year: 11 letters at least")
    entries, data = asked(parser, args.name)
    from tests.logs import golden
    from tests.logs.catalog import OtherLog

    folder = golden.HERE if args.here else None
    left = []
    for entry in entries:
        if entry.source and data is None:
            sys.stdout.write(f"{entry.name}: left as it is, {NO_DATA}\n")
            continue
        try:
            sys.stdout.write(bless(entry, data, reason, folder) + "\n")
        except OtherLog as error:
            sys.stdout.write(f"{entry.name}: left as it is, {error}\n")
            left.append(entry.name)
    return int(bool(left))


if __name__ == "__main__":
    sys.exit(main())
