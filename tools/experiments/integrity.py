"""Integrity runs: ``python -m tools.experiments.integrity --count 10 --jobs 2``; resumable, one file a scenario.

Every scenario of :mod:`tools.experiments.integrity_scene` goes through the daemon's own cycle in virtual time; the
published state is judged against the truth. Tracks are kept in ``<out>/<kind>-<seed>.npz`` and not made again; delete
them to begin anew. ``--report`` only says what the kept ones show; ``--plot FILE`` draws error against bound.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import numpy as np

from tools.experiments.integrity_report import report
from tools.experiments.integrity_run import run
from tools.experiments.integrity_scene import KINDS, draw

OUT: Final = Path("out/integrity")


def make(task: tuple[str, int, Path]) -> tuple[str, int, float]:
    """Run one scenario and keep its track; returns what it cost in CPU seconds, negative where there is no such."""
    kind, seed, out = task
    logging.disable(logging.CRITICAL)  # what thousands of simulated robots have to say
    begun = time.process_time()
    try:
        scene = draw(kind, seed)
    except RuntimeError:  # a room so full that nothing can drive in it
        return kind, seed, -1.0
    track = run(scene)
    facts = {"lit": scene.lit, "wheels": scene.wheels, "clean": scene.clean, **scene.notes}
    path = out / f"{kind}-{seed}.npz"
    partial = path.with_suffix(".part")
    with partial.open("wb") as file:
        np.savez_compressed(
            file, track=track.astype(np.float32), recoverable=np.array(scene.recoverable).reshape(-1, 2),
            facts=np.array(repr(facts)), clean=scene.clean, lit=scene.lit,
        )  # fmt: skip
    partial.replace(path)
    return kind, seed, time.process_time() - begun


def missing(kinds: list[str], seeds: range, out: Path) -> list[tuple[str, int, Path]]:
    """Scenarios that have no track yet, seed by seed, so that every kind has its share whenever it is stopped."""
    return [(kind, seed, out) for seed in seeds for kind in kinds if not (out / f"{kind}-{seed}.npz").exists()]


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Options; an unknown kind ends the program with the list of those that there are."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.experiments.integrity", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--kind", action="append", choices=sorted(KINDS), help="only this kind (may be repeated)")
    parser.add_argument("--count", type=int, default=2, help="seeds of each kind (default: 2)")
    parser.add_argument("--first", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the tracks")
    parser.add_argument("--report", action="store_true", help="run nothing, say what the kept tracks show")
    parser.add_argument("--plot", type=Path, help="PNG to draw error against bound into")
    parser.add_argument("--alert", type=float, default=1.0, help="alert limit in the plot, m (default: 1)")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing, then report; exit status 1 where a state was wrong for too long."""
    options = parse(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    kinds = options.kind or list(KINDS)
    if not options.report:
        tasks = missing(kinds, range(options.first, options.first + options.count), options.out)
        with get_context("spawn").Pool(options.jobs) as pool:
            for number, (kind, seed, seconds) in enumerate(pool.imap_unordered(make, tasks), 1):
                print(f"{number}/{len(tasks)} {kind} {seed}: {seconds:.1f} s", file=sys.stderr, flush=True)
    found = report(options.out, kinds)
    print(found.text())
    if options.plot is not None:
        from tools.experiments.integrity_plot import stanford

        stanford(found, options.plot, options.alert)
    return int(found.wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
