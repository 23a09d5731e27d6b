"""Replay of real logs: accuracy against relations found by hand, and speed against the drive itself.

Needs ``LUMILOOP_DATA``. Speed is of one process on one core, reading and results left out; the peer is real time.
"""

import os
import statistics
import tempfile
from pathlib import Path
from typing import Final

from daemon.config.schema import Config
from daemon.replay import convert
from daemon.replay.log_replay import Outcome, replay
from daemon.replay.sources import open_log
from tools.ci.figures import Figure, bounded
from tools.relations import SPLIT_S, Errors, evaluate, read_relations

COMMAND: Final = "LUMILOOP_DATA=... python -m tools.bench replay"


def run() -> list[Figure]:
    """Replay the logs and judge them.

    Raises:
        RuntimeError: LUMILOOP_DATA does not name the folder of real logs.
    """
    data = os.environ.get("LUMILOOP_DATA")
    if not data:
        raise RuntimeError("LUMILOOP_DATA does not name the folder of real logs (see docs/data.md)")
    return [*_intel(Path(data) / "intel"), *_utm(Path(data) / "utm30lx" / "scans.npz")]


def _intel(folder: Path) -> list[Figure]:
    outcome = replay(open_log(folder / "intel.clf.gz"), Config())
    relations = read_relations(folder / "intel.relations")
    final, online = outcome.rerun.ledger.final(), outcome.rerun.ledger.online()
    alone = evaluate(final.stamps, outcome.rerun.ledger.odom(), relations)
    figures = _accuracy("intel, front end alone (T_odom_base)", alone, (0.0165, 0.385))
    figures += _accuracy("intel, at the end", evaluate(final.stamps, final.poses, relations))
    figures += _accuracy("intel, as published", evaluate(online.stamps, online.poses, relations))
    figures.append(Figure("intel, T_map_odom jumps", outcome.rerun.ledger.jumps, "", command=COMMAND))
    median = 1e3 * statistics.median(outcome.rerun.timing.steps)
    figures.append(bounded("intel, front end with map work, median of a scan", median, "ms", "<= 0.34", COMMAND))
    figures.append(bounded("intel, replay speed", _speed(outcome), "x real time", ">= 100", COMMAND))
    figures.append(Figure("intel, reading the log", outcome.seconds["read"], "s", command=COMMAND))
    return figures


def _accuracy(name: str, errors: Errors, bounds: tuple[float, float] = (0.022, 0.55)) -> list[Figure]:
    """Errors in metres and degrees; ``bounds`` are for relations between poses close in time."""
    local, whole = errors.within(SPLIT_S), errors.beyond(SPLIT_S)
    return [
        bounded(f"{name}: translation within 30 s", local.translation_m.mean(), "m", f"<= {bounds[0]}", COMMAND),
        bounded(f"{name}: rotation within 30 s", local.rotation_deg.mean(), "deg", f"<= {bounds[1]}", COMMAND),
        Figure(f"{name}: translation beyond 30 s", whole.translation_m.mean(), "m", command=COMMAND),
        Figure(f"{name}: rotation beyond 30 s", whole.rotation_deg.mean(), "deg", command=COMMAND),
        Figure(f"{name}: translation, all", errors.translation_m.mean(), "m", command=COMMAND),
        Figure(f"{name}: rotation, all", errors.rotation_deg.mean(), "deg", command=COMMAND),
    ]


def _utm(source: Path) -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "utm.log"
        convert.write(log, convert.read(source), source.name)
        outcome = replay(open_log(log), Config())
    speed = _speed(outcome)
    return [bounded("utm30lx, 1081 beams at 40 Hz, replay speed", speed, "x real time", ">= 8", COMMAND)]


def _speed(outcome: Outcome) -> float:
    return (outcome.rerun.t_mono - outcome.rerun.t_first) / outcome.seconds["run"]
