"""Replay of one log from opening to outcome, through the daemon's own pipeline or another method."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

from daemon.config.schema import Config
from daemon.recording.recorder import MAP
from daemon.replay.recorded_inputs import NOTHING_GIVEN, Given, config_for, lights_for, start_for
from daemon.replay.runner import Rerun
from daemon.replay.sources import Source
from daemon.runtime import warmup
from daemon.system import console
from estimator.paper import LUMILOOP
from hal.errors import HalError

if TYPE_CHECKING:  # loaded only if matches are requested
    from daemon.replay.match_journal import MatchJournal

PROGRESS_S: Final = 1.0


@dataclass(slots=True)
class Outcome:
    """Outcome of a replay; ``stopped``: why it ended before the log did, empty otherwise."""

    source: Source
    config: Config
    rerun: Rerun
    journal: MatchJournal | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    stopped: str = ""


def replay(
    source: Source,
    config: Config,
    given: Given = NOTHING_GIVEN,
    journal: MatchJournal | None = None,
    method: str = LUMILOOP,
) -> Outcome:
    """Replays a log through the pipeline, or through another method.

    Args:
        source: the log, opened and not replayed yet.
        config: resolved configuration.
        given: the part of it that the operator has set; the log supplies the rest where it contains it.
        journal: matches to keep for inspection.
        method: name of the method, see `estimator.paper.METHODS`.

    Raises:
        HalError: the log cannot be used. Later errors end the run and are in `Outcome.stopped`.
    """
    begun = time.perf_counter()
    used = config_for(source, config, given)
    lights = lights_for(source, used, given)
    if lights is not None:
        warmup.load_aloud(console.say, "warm-lights", partial(warmup.load, lights))
    if method == LUMILOOP:
        start = start_for(source, used, lights, given)
    else:
        start = None
        _load_method(source, given, method)
    outcome = Outcome(source, used, Rerun(source, used, lights, journal, start, method), journal)
    outcome.seconds["read"] = source.read_s + time.perf_counter() - begun
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


def _load_method(source: Source, given: Given, method: str) -> None:
    """Loads the kernels of another method than the daemon's, and notes that it begins without a stored map."""
    warmup.load_aloud(console.say, "warm-methods", warmup.load, "estimator.paper.methods")
    if source.begin is not None or MAP in source.header or any(key.startswith("map.") for key in given.keys):
        source.report.notes.append(f"method {method} begins with an empty map; a stored map or checkpoint is not used")


def _play(rerun: Rerun, source: Source) -> None:
    begun = shown = time.perf_counter()
    for event in source.events():
        rerun.feed(event)
        now = time.perf_counter()
        if now - shown >= PROGRESS_S:
            shown = now
            speed = (rerun.t_mono - rerun.t_first) / (now - begun)
            part = 100 * source.done // max(1, source.total)
            console.progress(f"replay: {part} %, {len(rerun.ledger)} scans, {speed:.0f} x real time")
