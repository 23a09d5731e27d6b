"""`lumiloop replay LOG --out DIR`: a log through the daemon's own pipeline, as fast as it goes, results as files.

Two replays of one log write identical bytes; what was measured with a watch stands apart, in ``timing.json``. Whatever
stops a replay early, an unreadable part of the log or a person, what has been computed until then is written.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from daemon.cli import parser
from daemon.config.loader import brought_up
from daemon.config.schema import Config, Mount
from daemon.maps.container import BadMap
from daemon.maps.image import meta_of, packed
from daemon.maps.store import START, NoMap, Start, recorded_start, started
from daemon.recording.recorder import MAP
from daemon.replay.results import Folder, OutputRefused, guessed, map_files, tum
from daemon.replay.runner import Rerun
from daemon.replay.sources import Source, open_log, sha256_of
from daemon.replay.trajectories import Ledger
from daemon.runtime import warmup
from daemon.runtime.light_setup import Lights, SurveyError, from_header, load_lights, lost_residuals
from daemon.system.versions import release, versions
from estimator import Grid, Identity
from hal.errors import DataInvalid, HalError

if TYPE_CHECKING:  # loaded only where somebody asks for matches
    from daemon.replay.match_journal import MatchJournal

PROGRESS_S: Final = 1.0
LONGEST_NAME: Final = 64
"""Of a map."""
LOOPS_HEAD: Final = "stamp,counter,keyframe_new,keyframe_old,residual_m\n"


@dataclass(frozen=True, slots=True)
class Given:
    """What of the configuration a person has asked for: a whole ``file``, and single ``keys`` (dotted paths)."""

    file: bool = False
    keys: tuple[str, ...] = ()


NOTHING_GIVEN: Final = Given()


@dataclass(slots=True)
class Outcome:
    """What a run over a log has come to; ``stopped`` says why it ended before the log did, empty otherwise."""

    source: Source
    config: Config
    rerun: Rerun
    journal: MatchJournal | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    stopped: str = ""


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    if args.journal is None and args.journal_at is None:
        return command(args, _write_all)
    from daemon.replay import match_journal

    try:
        wanted = match_journal.choice_of(args.journal, args.journal_at)
    except match_journal.BadChoice as error:
        return parser.fail(str(error), parser.USAGE)
    return command(args, _write_all, match_journal.MatchJournal(wanted))


def command(
    args: argparse.Namespace, write: Callable[[Folder, Outcome], None], journal: MatchJournal | None = None
) -> int:
    """Replay ``args.log``, let ``write`` put results into ``args.out``, and say how it went; returns the exit code."""
    try:
        folder = Folder(args.out)
        keys = tuple(override.partition("=")[0].strip() for override in args.set)
        outcome = replay(args.log, args.settings, Given(args.config is not None, keys), journal)
        write(folder, outcome)
    except (HalError, OutputRefused, warmup.CannotLoad) as error:
        return parser.fail(str(error))
    if outcome.stopped:
        return parser.fail(f"{outcome.stopped}; what was computed until then is in {folder.path}", _code(outcome))
    return _verdict(outcome)


def replay(path: Path, config: Config, given: Given = NOTHING_GIVEN, journal: MatchJournal | None = None) -> Outcome:
    """Run a log through the pipeline.

    Args:
        path: the log.
        config: resolved configuration.
        given: what of it a person has asked for; what nobody asked for is taken from a log that knows it.
        journal: which matches are kept to be looked at.

    Raises:
        HalError: the log cannot be opened; what goes wrong later ends the run and is said in `Outcome.stopped`.
    """
    begun = time.perf_counter()
    _say(f"replay: reading {path}")
    source = open_log(path)
    used = config_for(source, config, given)
    lights = lights_for(source, used, given)
    if lights is not None:
        warmup.load_aloud(parser.say, "warm-lights", partial(warmup.load, lights))
    start = start_for(source, used, lights, given)
    outcome = Outcome(source, used, Rerun(source, used, lights, journal, start), journal)
    outcome.seconds["read"] = time.perf_counter() - begun
    begun = time.perf_counter()
    try:
        _play(outcome.rerun, source)
    except HalError as error:
        outcome.stopped = str(error)
    except KeyboardInterrupt:
        outcome.stopped = "interrupted"
    outcome.rerun.finish()
    outcome.seconds["run"] = time.perf_counter() - begun
    return outcome


def config_for(source: Source, config: Config, given: Given) -> Config:
    """The configuration that counts: a person's, else the recording's, with the log's mount where none was given."""
    if source.recorded and not given.file:
        tree = brought_up(dict(source.header.get("config", {})))
        try:
            return msgspec.convert(_laid_over(tree, msgspec.to_builtins(config), given.keys), Config)
        except msgspec.ValidationError as error:
            source.report.notes.append(f"the recording's configuration is not of this version ({error}): not used")
    asked = any(key.startswith("lidar.mount") for key in given.keys) or config.lidar.mount != Mount()
    if source.mount is None or asked:
        return config
    x, y, yaw = source.mount
    lidar = msgspec.structs.replace(config.lidar, mount=Mount(x=x, y=y, yaw=math.degrees(yaw)))
    return msgspec.structs.replace(config, lidar=lidar)


def lights_for(source: Source, used: Config, given: Given) -> Lights | None:
    """What the estimator is told of lights: as recorded, unless a person has asked for another survey or none.

    The recorded sample clock counts in any case, except for another air interface than the recorded one.

    Raises:
        DataInvalid: what was recorded, or the survey asked for, cannot be used.
    """
    if not (source.recorded and used.photodiode.fitted):
        return None
    asked = given.file or any(key.startswith(("lights.", "photodiode.")) for key in given.keys)
    try:
        return load_lights(used, _recorded_clock(source, used)) if asked else _recorded_lights(source)
    except (SurveyError, ValueError) as error:
        raise DataInvalid(str(source.path), str(error), "name a survey with --set lights.survey=FILE") from error


def start_for(source: Source, used: Config, lights: Lights | None, given: Given) -> Start | None:
    """The map that the run began with; that of ``map.folder`` only where a person has asked for it. None: with none.

    Raises:
        DataInvalid: the map asked for, or recorded, cannot be used.
    """
    if source.begin is not None:
        return None
    try:
        named = given.file and used.map.folder and not source.recorded
        if named or any(key.startswith("map.") for key in given.keys):
            store, start = started(used.map, lights, mend=False)
            if store is not None and start is None:
                lacks = f"{store.folder} holds no map that can be used"
                if "map.folder" in given.keys:
                    raise DataInvalid(str(source.path), lacks, "name another folder, or --set map.folder=none")
                source.report.notes.append(f"{lacks}: replayed without one")
            return start
        if not source.recorded or MAP not in source.header:
            return None
        path, sha256 = source.files[0].parent / START, source.header[MAP]["sha256"]
        return recorded_start(path, sha256, lights, used.map.localise)
    except (NoMap, BadMap, OSError) as error:
        remedy = "replay the recording with the files that it was written with, or name a map with --set map.folder=DIR"
        raise DataInvalid(str(source.path), f"the map it began with cannot be used: {error}", remedy) from error


def _recorded_lights(source: Source) -> Lights | None:
    folder = source.files[0].parent
    lights = from_header(source.header, folder)
    if lights is not None and lost_residuals(source.header, lights):
        source.report.notes.append(
            f"the residual map it was made with is not in {folder} any more, or damaged: replayed without it"
        )
    return lights


def _recorded_clock(source: Source, used: Config) -> float | None:
    """The sample clock that the recorded run was told, in ppm; None where it cannot be that of this run."""
    try:
        recorded = from_header(source.header)
    except ValueError:
        return None
    same = recorded is not None and recorded.profile.name == used.photodiode.profile
    return recorded.clock_ppm if recorded is not None and same else None


def _laid_over(tree: dict[str, Any], config: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """``tree`` with the values that ``config`` has for ``keys`` (dotted paths)."""
    for key in keys:
        branch, chosen = tree, config
        *parents, last = key.split(".")
        for parent in parents:
            branch, chosen = branch.setdefault(parent, {}), chosen[parent]
        branch[last] = chosen[last]
    return tree


def _play(rerun: Rerun, source: Source) -> None:
    begun = shown = time.perf_counter()
    for event in source.events():
        rerun.feed(event)
        now = time.perf_counter()
        if now - shown >= PROGRESS_S:
            shown = now
            speed = (rerun.t_mono - rerun.t_first) / (now - begun)
            part = 100 * source.done // max(1, source.total)
            _say(f"replay: {part} %, {len(rerun.ledger)} scans, {speed:.0f} x real time")


def _say(text: str) -> None:
    """One line on stderr: overwritten on a terminal, one below the other elsewhere."""
    sys.stderr.write(f"\r\x1b[K{text}" if sys.stderr.isatty() else f"{text}\n")
    sys.stderr.flush()


def _code(outcome: Outcome) -> int:
    return parser.INTERRUPTED if outcome.stopped == "interrupted" else parser.FAILED


def _verdict(outcome: Outcome) -> int:
    """Last words on stderr, and the exit code: a replay without a pose has failed."""
    source, rerun = outcome.source, outcome.rerun
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    for sentence in source.report.sentences():
        sys.stderr.write(f"replay: {source.path}: {sentence}\n")
    for sentence in () if outcome.journal is None else outcome.journal.sentences():
        sys.stderr.write(f"replay: {sentence}\n")
    if not len(rerun.ledger):
        sources = "a scan or light" if rerun.blocks else "a scan"
        return parser.fail(f"{source.path}: {source.kind} without {sources} that gave a pose")
    if rerun.comparison.differ:
        first = rerun.comparison.first
        sys.stderr.write(f"replay: {rerun.comparison.differ} cycles differ from the recorded run; {first}\n")
    if outcome.journal is not None and outcome.journal.missed():
        return parser.fail("none of the matches asked for is in the log; the other results are written")
    log_s, run_s = rerun.t_mono - rerun.t_first, outcome.seconds["run"]
    speed = f"{log_s:.1f} s of log in {run_s:.1f} s ({log_s / run_s:.0f} x real time)"
    for sentence in filter(None, (f"{len(rerun.ledger)} poses, {speed}", guessed(rerun.ledger.online()))):
        sys.stderr.write(f"replay: {sentence}\n")
    return parser.OK


def _write_all(folder: Folder, outcome: Outcome) -> None:
    """Every result that there is room for; each file is written whole or not at all."""
    begun = time.perf_counter()
    ledger = outcome.rerun.ledger
    final, grid = ledger.final(), outcome.rerun.render()
    files = [
        ("trajectory.tum", tum(final)),
        ("online.tum", tum(ledger.online())),
        ("loops.csv", _loops(ledger)),
        ("map.lumimap", _map(outcome)),
        *map_files(grid, final.poses, outcome.rerun.lamps()),
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
    """The map as ``lumiloop run`` keeps it, the same each time."""
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
    """Everything about a replay that is the same each time."""
    source, rerun, ledger = outcome.source, outcome.rerun, outcome.rerun.ledger
    step_m, step_rad, step_at = ledger.largest_step()
    driven_m, turned_rad = ledger.way()
    rows, columns = grid.log_odds.shape
    return {
        "log": {
            "name": source.path.name,
            "kind": source.kind,
            "sha256": sha256_of(source),
            "seconds": rerun.t_mono - rerun.t_first if ledger.cycles else 0.0,
            "report": source.report.as_dict(),
            "lidar": {"missed": source.status.missed, "invalid": source.status.invalid},
            "recorded_versions": source.header.get("versions"),
        },
        "complete": not outcome.stopped,
        "stopped": outcome.stopped,
        "counts": {
            "scans": source.status.scans,
            "poses": len(ledger),
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
    """The matches that are written; None where none were asked for."""
    if outcome.journal is None:
        return None
    return [asdict(name) for name in outcome.journal.named(outcome.rerun.ledger.online().stamps)]


def _recorded(outcome: Outcome) -> dict[str, Any] | None:
    """How a recording's replay compares with what was recorded; None for other logs."""
    compared = outcome.rerun.comparison
    if not outcome.source.recorded:
        return None
    return {
        "cycles": compared.cycles,
        "differ": compared.differ,
        "first_difference": compared.first,
        "judged": compared.judged,
        "published_with": {str(fault): count for fault, count in compared.faults.items()} if compared.judged else None,
    }


def timing(outcome: Outcome) -> dict[str, Any]:
    """What was measured with a watch."""
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
