"""Integrity: is what the daemon says of random drives ever wrong?

``python -m tools.experiments --only integrity --trials 10``; resumable, one file a scenario.

Every scenario of :mod:`tools.experiments.integrity.scene` goes through the daemon's own cycle in virtual time; the
published state is judged against the truth. Tracks are kept in ``out/integrity/<code>/<kind>-<seed>.npz``
and not made again; delete them to begin anew.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Final

import numpy as np

from tools.ci.figures import bounded
from tools.experiments.integrity import run as integrity_run
from tools.experiments.integrity.plot import stanford
from tools.experiments.integrity.report import KIND_HEAD, Summary, report
from tools.experiments.integrity.scene import KINDS, draw
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work, code

OUT: Final = Path("out/integrity")
SEEDS: Final = 60
ALERT_M: Final = 1.0
SOURCES: Final = ("estimator/**/*.py", "daemon/**/*.py", "tools/sim/**/*.py", "tools/experiments/integrity/*.py")


def make(task: tuple[str, int, Path]) -> tuple[str, int, float]:
    """Run one scenario and keep its track; returns what it cost in CPU seconds, negative where there is no such."""
    kind, seed, out = task
    logging.disable(logging.CRITICAL)  # what thousands of simulated robots have to say
    begun = time.process_time()
    try:
        scene = draw(kind, seed)
    except RuntimeError:  # a room so full that nothing can drive in it
        return kind, seed, -1.0
    track = integrity_run.run(scene)
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


def run(quick: bool, work: Work) -> Report:
    """Every kind with ``work.trials`` seeds (60); with ``quick`` one of the cheapest kind. Tracks are kept."""
    out = OUT / code(*SOURCES)
    out.mkdir(parents=True, exist_ok=True)
    kinds, seeds = (list(KINDS)[:1], range(1)) if quick else (list(KINDS), range(work.trials or SEEDS))
    work.map(make, missing(kinds, seeds, out), "integrity")
    return told(report(out, kinds), seeds)


def told(found: Summary, seeds: range) -> Report:
    """What the tracks show, as an experiment's report."""
    rows = [
        (each.name, each.worst_m, each.worst_deg, each.wrong_s, 100.0 * each.tracking, each.beyond_bound, each.bounded)
        for each in found.found
        if each.wrong or each.beyond_bound
    ]
    head = ("", "worst, m", "worst, deg", "wrong, s", "TRACKING, %", "cycles beyond the bound", "of cycles")
    figure = bounded(f"wrong states, of {len(found.found)} scenarios", found.wrong, "", "<= 0", f"{COMMAND} integrity")
    picture = Picture("stanford", lambda canvas: stanford(found, canvas, ALERT_M), (6.4, 5.2))
    notes = tuple(line.strip() for line in found.figures())
    kinds = Table("By kind of scenario", KIND_HEAD, found.kinds())
    tables = (kinds, Table("Scenarios in which a state or a bound was wrong", head, tuple(rows))) if rows else (kinds,)
    return Report((figure,), tables, (picture,), tuple(seeds), notes)


def missing(kinds: list[str], seeds: range, out: Path) -> list[tuple[str, int, Path]]:
    """Scenarios that have no track yet, seed by seed, so that every kind has its share whenever it is stopped."""
    return [(kind, seed, out) for seed in seeds for kind in kinds if not (out / f"{kind}-{seed}.npz").exists()]
