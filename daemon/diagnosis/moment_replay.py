"""Replay of a recording around an instant."""

from __future__ import annotations

import math
import time
from functools import partial

from daemon.config.schema import Config
from daemon.diagnosis import moment
from daemon.diagnosis.moment import Moment
from daemon.diagnosis.recorded_spans import AFTER_S, BEFORE_S, NoMoment, Span
from daemon.replay.recorded_inputs import NOTHING_GIVEN, config_for, lights_for, start_for
from daemon.replay.runner import Rerun
from daemon.replay.sources import RecordingSource, Turn
from daemon.runtime import warmup
from daemon.runtime.cycle_parts import CycleRecord
from daemon.system import console


def moments(span: Span, utc: float) -> tuple[list[Moment], Rerun]:
    """Replays every cycle around an instant (``utc``, s).

    Raises:
        HalError: the recording cannot be replayed.
    """
    t_mono = utc - span.utc_at_zero
    source = RecordingSource(span.path, until=t_mono - BEFORE_S)
    config = config_for(source, Config(), NOTHING_GIVEN)
    lights = lights_for(source, config, NOTHING_GIVEN)
    if lights is not None:
        warmup.load_aloud(console.say, "warm-lights", partial(warmup.load, lights))
    rerun = Rerun(source, config, lights, None, start_for(source, config, lights, NOTHING_GIVEN))
    records: list[CycleRecord] = []
    rerun.watch = records.append
    told: list[Moment] = []
    shown = time.monotonic()
    for event in source.events():
        rerun.feed(event)
        if isinstance(event, Turn) and records:
            if event.t_mono >= t_mono - BEFORE_S:
                told.append(moment.moment_of(span.utc_at_zero, event.entry, records[-1], rerun.cycle))
            records.clear()
            if event.t_mono > t_mono + AFTER_S:
                break
            if time.monotonic() - shown > 5.0:
                console.say(f"replaying, {max(0.0, t_mono - event.t_mono):.0f} s before it")
                shown = time.monotonic()
    rerun.finish()
    if not told or math.isinf(told[0].utc):
        raise NoMoment("no cycle was recorded around that time")
    return told, rerun
