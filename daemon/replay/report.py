"""Result files of a replay: trajectories, loops, map and a reproducible summary; timing is in a file of its own."""

from __future__ import annotations

import json
import time
import zlib
from dataclasses import asdict
from typing import Any, Final

import msgspec

from daemon.maps.grid_files import map_files
from daemon.maps.image import meta_of, packed
from daemon.replay.log_replay import Outcome
from daemon.replay.results import Folder, tum
from daemon.replay.sources import sha256_of
from daemon.replay.trajectories import Ledger
from daemon.system.versions import release, versions
from estimator import Grid, Identity
from estimator.paper import LUMILOOP

LONGEST_NAME: Final = 64
"""Longest name of a map, characters."""
SCHEMA: Final = "lumiloop.replay/1"
LOOPS_HEAD: Final = "stamp,counter,keyframe_new,keyframe_old,residual_m\n"


def write_all(folder: Folder, outcome: Outcome, margin_m: float | None = None) -> None:
    """Writes every result that there is room for; each file appears whole or not at all.

    ``margin_m``: map.png shows only this much around the path, m; None: all.
    """
    begun = time.perf_counter()
    ledger = outcome.rerun.ledger
    final, grid = ledger.final(), outcome.rerun.render()
    files = [
        ("trajectory.tum", tum(final)),
        ("online.tum", tum(ledger.online())),
        ("loops.csv", _loops(ledger)),
        ("map.lumimap", _map(outcome)),
        *map_files(grid, final.poses, outcome.rerun.lamps(), margin_m),
        ("summary.json", _json(summary(outcome, grid))),
    ]
    try:
        folder.write_each(files)
        if outcome.journal is not None:
            outcome.journal.clear(folder.path)
            folder.write_each(outcome.journal.files(ledger.online().stamps))
    finally:
        outcome.seconds["write"] = time.perf_counter() - begun
        folder.write("timing.json", _json(timing(outcome)))


def _map(outcome: Outcome) -> bytes:
    """Returns the map file as ``lumiloop run`` stores it; reproducible."""
    map_id = zlib.crc32(outcome.source.path.name.encode()) | 1
    image = outcome.rerun.image(Identity(map_id, outcome.source.path.name[:LONGEST_NAME], session=1))
    return packed(image, meta_of(image, 0.0, outcome.config.name, release()))


def _loops(ledger: Ledger) -> bytes:
    lines = [
        f"{stamp:.6f},{loop.counter},{loop.keyframe_new},{loop.keyframe_old},{loop.residual_m:.6f}\n"
        for stamp, loop in ledger.loops
    ]
    return (LOOPS_HEAD + "".join(lines)).encode()


def _json(content: dict[str, Any]) -> bytes:
    return (json.dumps(content, indent=2, sort_keys=True) + "\n").encode()


def summary(outcome: Outcome, grid: Grid) -> dict[str, Any]:
    """Returns the reproducible part of a replay's results."""
    source, rerun, ledger = outcome.source, outcome.rerun, outcome.rerun.ledger
    step_m, step_rad, step_at = ledger.largest_step()
    driven_m, turned_rad = ledger.way()
    rows, columns = grid.log_odds.shape
    return {
        "schema": SCHEMA,
        "log": {
            "name": source.path.name,
            "kind": source.kind,
            "sha256": sha256_of(source),
            "seconds": rerun.t_mono - rerun.t_first if ledger.cycles else 0.0,
            "report": source.report.as_dict(),
            "lidar": {"missed": source.status.missed, "invalid": source.status.invalid},
            "recorded_versions": source.header.get("versions"),
        },
        "method": rerun.method,
        "complete": not outcome.stopped,
        "stopped": outcome.stopped,
        "counts": {
            "scans": source.status.scans,
            "poses": len(ledger),
            "guesses": sum(map(bool, ledger.online().guesses())),
            "cycles": ledger.cycles,
            "dropped": ledger.dropped,
            "odometry": rerun.readings,
            "blocks": rerun.blocks,
            "keyframes": ledger.keyframes,
            "matched": ledger.matched,
            "outcomes": dict(ledger.outcomes),
            "states": dict(ledger.states),
            "loops": ledger.loops[-1][1].counter if ledger.loops else 0,
            "steps_with_loops": len(ledger.loops),
        },
        "motion": {
            "driven_m": driven_m,
            "turned_rad": turned_rad,
            "odometry_m": rerun.odometry_m,
            "T_odom_base_largest_step_m": step_m,
            "T_odom_base_largest_step_stamp": step_at,
            "T_odom_base_largest_turn_rad": step_rad,
            "match_largest_correction_m": ledger.corrected_m,
            "match_largest_correction_rad": ledger.corrected_rad,
            "T_map_odom_jumps": ledger.jumps,
        },
        "matches": _matches(outcome),
        "map": {"resolution_m": grid.resolution, "columns": columns, "rows": rows},
        "recorded_run": _recorded(outcome),
        "config": msgspec.to_builtins(outcome.config),
        "versions": versions(),
    }


def _matches(outcome: Outcome) -> list[dict[str, Any]] | None:
    """Returns the written matches; None if none were requested."""
    if outcome.journal is None:
        return None
    return [asdict(name) for name in outcome.journal.named(outcome.rerun.ledger.online().stamps)]


def _recorded(outcome: Outcome) -> dict[str, Any] | None:
    """Returns the comparison with the recorded run; None for other logs and other methods."""
    compared = outcome.rerun.comparison
    if not outcome.source.recorded or outcome.rerun.method != LUMILOOP:
        return None
    return {
        "cycles": compared.cycles,
        "differ": compared.differ,
        "first_difference": compared.first,
        "judged": compared.judged,
        "published_with": {str(fault): count for fault, count in compared.faults.items()} if compared.judged else None,
    }


def timing(outcome: Outcome) -> dict[str, Any]:
    """Returns the measured durations."""
    rerun, run_s = outcome.rerun, outcome.seconds["run"]
    cycles = sorted(rerun.timing.cycles) or [0.0]
    log_s = rerun.t_mono - rerun.t_first if rerun.timing.cycles else 0.0
    return {
        "seconds": {name: round(value, 4) for name, value in outcome.seconds.items()},
        "log_seconds": log_s,
        "times_real_time": log_s / run_s if run_s > 0.0 else 0.0,
        "cycle_us": {
            str(p): round(1e6 * cycles[min(len(cycles) - 1, int(len(cycles) * p / 100))]) for p in (50, 90, 99)
        },
        "step_us_mean": round(1e6 * sum(rerun.timing.steps) / len(cycles)),
        "cycle_us_mean": round(1e6 * sum(cycles) / len(cycles)),
    }
