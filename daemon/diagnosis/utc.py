"""Which UTC belongs to a recording's monotonic clock: the computer's clock may be set while it is recorded.

A computer without a battery for its clock begins with any time, and sets it once it has a network. Every head says
both clocks at the moment when it was written, and the recorder begins a segment where they have come apart. So a
recording is a row of parts, in each of which UTC goes on with the monotonic clock; a moment is reckoned by the clock
of its part, and whatever is told around it as well.
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
"""Beyond the year 5000."""

Pair = tuple[float, float]
"""Both clocks at one moment, s: ``t_mono``, UTC."""


class Part(NamedTuple):
    """From ``t_mono``, s, on UTC is ``t_mono + utc_at_zero``; ``step``, s: how far it was set then, if it was."""

    t_mono: float
    utc_at_zero: float
    step: float = 0.0


def parts(folder: Path, segments: Sequence[Path], begun: Pair, t_mono: float) -> list[Part]:
    """The parts of a recording from ``t_mono``, s, on; ``begun``: both clocks when the run began.

    Where no segment says them (they are of older software), a dump that does counts for all that is in it: it was made
    at its end, and clocks are set soon after a start. When that was is not known.
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
    """What is to be known of a clock that was set by ``came`` and ``gone``, s, where a part begins and ends (UTC).

    It was set a moment before it was seen to be.
    """
    steps = ((came, begin, "after"), (gone, end, "before"))
    return [
        f"the clock was set by {step:+.3f} s, by {clock(utc)} at the latest; all times here are as {side} that"
        for step, utc, side in steps
        if step
    ]


def _ahead(pair: Pair) -> float:
    return pair[1] - pair[0]


def pair_of(t_mono: Any, t_utc: Any) -> Pair | None:
    """Both clocks as a file says them; None where those are no times that can be."""
    try:
        pair = float(t_mono), float(t_utc)
    except (TypeError, ValueError, OverflowError):
        return None
    return pair if all(abs(one) < EVER_S for one in pair) else None  # not a number is neither


def _of(header: Any) -> Pair | None:
    told = header.get(CLOCK) if isinstance(header, dict) else None
    return pair_of(*told) if isinstance(told, list) and len(told) == 2 else None


def _of_state(segments: Sequence[Path]) -> list[Pair]:
    """Of the state that a recording begins with: it was taken before the segment had its head."""
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
