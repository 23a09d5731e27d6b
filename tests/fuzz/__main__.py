"""Fuzzing by hand and from the tests: ``python -m tests.fuzz [TARGET ...]``.

    python -m tests.fuzz                       # a tenth of the full size of each target
    python -m tests.fuzz log --share 1 --seed 7
    python -m tests.fuzz log --grow 300        # look for inputs that reach new lines, five minutes, and keep them

Growing uses atheris (libFuzzer; ``pip install atheris``) where it is installed, else a search of its own that is some
hundred times slower. What is found goes to tests/fuzz/corpus and is fed and damaged in every run from then on.
"""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
import time
from pathlib import Path

import coverage

from tests.fuzz.storm import say
from tests.fuzz.targets import NAMES

ROOT = Path(__file__).parents[2]
SAMPLE = 0.02
"""Share of a full run, over which lines are counted; that takes several times as long."""


def main() -> int:
    """Run what is asked for; 1 where something broke."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(NAMES)} (default: all)")
    parser.add_argument("--share", type=float, default=0.1, help="of the full size (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--grow", type=float, metavar="SECONDS", help="look for new inputs and keep them")
    options = parser.parse_args()
    names = options.targets or list(NAMES)
    if unknown := set(names) - set(NAMES):
        parser.error(f"no such target: {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    failed = 0
    for name in names:
        if options.grow:
            from tests.fuzz import grow

            failed |= grow.grow(name, options.grow)
        elif len(names) > 1:  # each by itself, or the first one has loaded the others' lines
            command = [
                sys.executable,
                "-m",
                "tests.fuzz",
                name,
                "--share",
                str(options.share),
                "--seed",
                str(options.seed),
            ]
            failed |= subprocess.run(command, cwd=ROOT, check=False).returncode
        else:
            failed |= one(name, options.share, options.seed)
    return failed


def one(name: str, share: float, seed: int) -> int:
    """One target: lines reached first, then the full load."""
    counted = coverage.Coverage(
        data_file=None, config_file=False, include=[str(ROOT / room / "**") for room in ("hal", "daemon", "estimator")]
    )
    counted.start()
    target = importlib.import_module(f"tests.fuzz.targets.{name}")
    from tests.fuzz import storm

    feed = target.feeder()
    kept = [*target.seeds(), *storm.corpus(name)]
    try:
        for data in kept:
            storm.tell(feed, data)
        sample = storm.Storm(kept, target.mend, seed + 1)
        fed, until = 0, SAMPLE * share * target.MEGABYTES * 1e6
        while fed < until:
            data = sample.next()
            storm.tell(feed, data)
            fed += max(len(data), 1)
        counted.stop()
        begin = time.thread_time()
        outcome = storm.run(feed, storm.Storm(kept, target.mend, seed), round(share * target.MEGABYTES * 1e6))
        took = time.thread_time() - begin
    except AssertionError as error:
        say(f"{name}: FAILED (seed {seed})\n{error}")
        return 1
    lines, reached = lines_of(counted, target.PARSERS)
    good = outcome.worst_s < storm.STALL_S and outcome.growth < storm.GROWTH
    say(
        f"{name}: {outcome.fed / 1e6:.2f} MB in {outcome.inputs} inputs, {took:.0f} s, longest"
        f" {1e3 * outcome.worst_s:.0f} ms, {outcome.growth / 1e3:+.1f} kB kept of all, {len(kept)} in the corpus,"
        f" {100.0 * reached / lines:.1f} % of {lines} lines{'' if good else ': FAILED'}"
    )
    return int(not good)


def lines_of(counted: coverage.Coverage, files: tuple[str, ...]) -> tuple[int, int]:
    """Lines that can run, and lines that did, of these files; those missed are told on request of a person."""
    lines = reached = 0
    for file in files:
        _, statements, _, missing, text = counted.analysis2(str(ROOT / file))
        lines, reached = lines + len(statements), reached + len(statements) - len(missing)
        if missing:
            say(f"    {file}: not reached {text}")
    return lines, reached


if __name__ == "__main__":
    raise SystemExit(main())
