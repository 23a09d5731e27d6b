"""UTC of a recording's monotonic clock, with the steps of the computer's clock during the recording.

A computer without a battery-backed clock starts with any time and is set once it has a network. Every segment head has
both clocks at the time of writing, and the recorder begins a segment after a step. A recording therefore consists of
parts in which UTC and the monotonic clock run together. The clock of a moment's part gives the time of the moment, and
all other times in its report.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

from daemon.diagnosis.moment import clock
from daemon.recording.disk_writer import CLOCK, STEP_S
from daemon.recording.replay_start import state_beside
from daemon.recording.retention import ABOUT
from hal.replay.recording import header_of

EVER_S: Final = 1e11
"""Largest valid time, s: beyond the year 5000."""

Pair = tuple[float, float]
"""Both clocks at one instant, s: ``t_mono``, UTC."""


class Part(NamedTuple):
    """From ``t_mono``, s, UTC is ``t_mono + utc_at_zero``; ``step``, s: by which the clock was set then, if it was."""

    t_mono: float
    utc_at_zero: float
    step: float = 0.0


def parts(folder: Path, segments: Sequence[Path], begun: Pair, t_mono: float) -> list[Part]:
    """Returns the parts of a recording from ``t_mono``, s; ``begun``: both clocks at the start of the run.

    Segments of older software lack them. A dump that has both clocks then applies to all of its content. It was made at
    its end, and clocks are set soon after a start. The time of the step is then not known.
    """
    told = [pair for segment in segments if (pair := _of(header_of(segment))) is not None]
    dumped = _of_dump(folder)
    if dumped is not None and not told:
        step = _ahead(dumped) - _ahead(begun)
        return [Part(t_mono, _ahead(dumped), step if abs(step) > STEP_S else 0.0)]
    known = chain([begun], told, _of_state(segments), [] if dumped is None else [dumped])
    found: list[Part] = []
    for pair in sorted(known):
        step = _ahead(pair) - found[-1].utc_at_zero if found else 0.0
        if not found or abs(step) > STEP_S:
            found.append(Part(pair[0], _ahead(pair), step))
    first = max((k for k, part in enumerate(found) if part.t_mono <= t_mono), default=0)
    return [Part(t_mono, found[first].utc_at_zero), *found[first + 1 :]]


def said(begin: float, came: float, end: float, gone: float) -> list[str]:
    """Returns remarks on clock steps of ``came`` and ``gone``, s, at the begin and end of a part (UTC, s).

    The step occurred a moment before it was detected.
    """
    steps = ((came, begin, "after"), (gone, end, "before"))
    return [
        f"the clock was set by {step:+.3f} s before {clock(utc)}; all times here are those {side} the step"
        for step, utc, side in steps
        if step
    ]


def _ahead(pair: Pair) -> float:
    return pair[1] - pair[0]


def pair_of(t_mono: Any, t_utc: Any) -> Pair | None:
    """Returns both clocks from a file; None if they are no valid times."""
    try:
        pair = float(t_mono), float(t_utc)
    except (TypeError, ValueError, OverflowError):
        return None
    return pair if all(abs(one) < EVER_S for one in pair) else None  # NaN fails this test too


def _of(header: Any) -> Pair | None:
    told = header.get(CLOCK) if isinstance(header, dict) else None
    return pair_of(*told) if isinstance(told, list) and len(told) == 2 else None


def _of_state(segments: Sequence[Path]) -> list[Pair]:
    """Returns the clocks of the first checkpoint, which was captured before the segment had its head."""
    from daemon.recording.state_file import BadState, read_header

    try:
        told = _of(read_header(state_beside(segments[0])))
    except (OSError, BadState, ValueError):
        return []
    return [] if told is None else [told]


def _of_dump(folder: Path) -> Pair | None:
    try:
        about = json.loads((folder / ABOUT).read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return pair_of(about.get("t_mono"), about.get("t_utc")) if isinstance(about, dict) else None
