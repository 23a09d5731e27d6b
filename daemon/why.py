"""`lumiloop why TIME`: replays what the flight recorder holds around a moment, and says why it was as it was.

The text is `daemon/whysaid.py`, the picture `daemon/whyplot.py`; here the recording is found, and replayed from the
last state before the moment.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from daemon import cli, warmup, whymoment, whyplot, whysaid
from daemon.config import Config
from daemon.cycle import CycleRecord
from daemon.extras import how_to_install
from daemon.folders import SERVICE_STATE, recordings_folder
from daemon.replay import NOTHING_GIVEN, config_for, lights_for, start_for
from daemon.rerun import Rerun
from daemon.results import Folder, OutputRefused
from daemon.sources import RecordingSource, Turn
from daemon.versions import made_elsewhere
from daemon.whymoment import Moment, chosen
from hal.errors import DataInvalid, DeviceMissing, HalError
from hal.replay.recording import SUFFIX, open_recording
from hal.replay.report import LogReport
from hal.replay.text import unreadable

FLIGHT: Final = "flight"
"""Folder below the state directory, ours or else the service's, where recordings are looked for if none is named."""
BEFORE_S, AFTER_S = 20.0, 5.0
"""How much around the moment is looked at."""
EVER_S: Final = 1e11
"""Beyond the year 5000."""
UNIX_S: Final = 1e8
"""A number of seconds beyond is since the Unix epoch, else since the recording began."""
DIGITS: Final = 6
"""Of a second's fraction, beyond which times are not told apart."""


class NoMoment(Exception):
    """There is no such moment in what was recorded; the text says what there is."""


@dataclass(frozen=True, slots=True)
class Span:
    """A recording, and the time (UTC) that it covers.

    Attributes:
        utc_at_zero: of its monotonic clock. made: with what, where that is not what runs now; empty otherwise.
    """

    path: Path
    begin: float
    end: float
    utc_at_zero: float
    made: str = ""


def main(args: argparse.Namespace) -> int:
    """The command's body; ``args``: the ``time`` as it was typed, ``log`` or None, where to draw (``out``) or None."""
    folder = args.log or recordings_folder(FLIGHT)
    try:
        if args.log is None and not _is_folder(folder):
            looked = f"nothing is recorded in {folder}, nor in {SERVICE_STATE / FLIGHT}"
            return cli.fail(f"{looked}; name a recording, or run with --record {folder} --last 10")
        span, utc, wide = find(spans(folder), args.time, folder)
        if args.out is not None:
            _try(args.out)
        told, rerun = moments(span, utc)
        second = whole_second(args.time)
        sys.stdout.write(whysaid.report(told, utc, span.path.name, wide, second, span.made))
        if rerun.comparison.differ:
            cli.say(
                f"the replay is not the recorded run ({rerun.comparison.first}): other software, or records are lost"
            )
        if args.out is not None:
            _draw(args.out, told, max(utc, told[chosen(told, utc, second, wide).cycle].utc), rerun)
    except (HalError, NoMoment, OutputRefused, warmup.CannotLoad) as error:
        return cli.fail(str(error))
    return cli.OK


def _try(out: Path) -> None:
    """Whether a picture can be drawn, and put there: known before anything is replayed; raises `OutputRefused`."""
    if find_spec("matplotlib") is None:
        raise OutputRefused(f"pictures need matplotlib: {how_to_install('plot')}")
    Folder(out.parent).demand(out.name)


def _draw(out: Path, told: list[Moment], utc: float, rerun: Rerun) -> None:
    Folder(out.parent).write(out.name, whyplot.draw(told, utc, rerun.render(), out.suffix[1:].lower()))


def spans(folder: Path) -> list[Span]:
    """The recordings and dumps in a folder, or the one that it is.

    Raises:
        HalError: it cannot be read, or there is none.
    """
    try:
        if not (_is_folder(folder) or folder.exists()):
            raise DeviceMissing(str(folder), "no such folder", "name a recording, a dump, or a folder of several")
        inside = sorted(path for path in folder.iterdir() if path.is_dir()) if _is_folder(folder) else []
    except OSError as error:
        raise unreadable(folder, error) from error
    runs = [path for path in inside if any(path.glob(f"*{SUFFIX}"))] or [folder]
    found = []
    for path in runs:
        try:
            found.append(_span(path))
        except DataInvalid as error:
            if len(runs) == 1:
                raise
            cli.say(f"{error}: passed over")
    return found


def _is_folder(path: Path) -> bool:
    """Raises `HalError` where that may not be known: what the service records lies in a folder of its own."""
    try:
        return path.is_dir()
    except OSError as error:
        raise unreadable(path, error) from error


def _span(path: Path) -> Span:
    recording = open_recording(path)
    source = RecordingSource(path)
    begun, utc = _begun(path, recording.header)
    begin = begun if source.begin is None else source.begin.t_mono
    last = open_recording(recording.segments[-1])
    end = max((frame.t_mono for frame in last.frames(LogReport())), default=begin)
    return Span(path, round(utc + begin, 6), round(utc + end, 6), utc, made_elsewhere(recording.header))


def _begun(path: Path, header: dict[str, Any]) -> tuple[float, float]:
    """When a run began, on its monotonic clock, and the UTC at which that clock was zero."""
    try:
        t_mono, t_utc = float(header["t_mono"]), float(header["t_utc"])
    except (KeyError, TypeError, ValueError) as error:
        problem = "its head does not say when it began, so no moment can be found in it"
        raise DataInvalid(str(path), problem, "replay it as a whole: lumiloop replay") from error
    if not (abs(t_mono) < EVER_S and abs(t_utc) < EVER_S):  # not a number is neither
        raise DataInvalid(str(path), "its head says no time that can be", "replay it as a whole: lumiloop replay")
    return t_mono, t_utc - t_mono


def find(recorded: list[Span], words: str, folder: Path) -> tuple[Span, float, float]:
    """The recording that holds a moment, and when that is.

    Returns:
        The recording with most of the time before it; the moment (UTC), to the microsecond; and how long it lasts, s,
        more than 0. Of a whole second a part may be recorded: then it is that part.

    Raises:
        NoMoment: none does, or that is no time.
    """
    wide = width(words)
    asked = [(span, round(utc, 6), round(utc + wide, 6)) for span in recorded for utc in meant(words, span)]
    here = [
        (min(begin - span.begin, BEFORE_S), span.begin, span, begin, round(end - begin, 6))
        for span, utc, end in asked
        if utc <= span.end and (begin := max(utc, span.begin)) < end
    ]
    if here:
        return max(here, key=lambda one: one[:2])[2:]
    there = "\n".join(
        f"  {whymoment.clock(s.begin)} to {whymoment.clock(s.end)}, {s.end - s.begin:.0f} s  {s.path.name}"
        for s in recorded
    )
    raise NoMoment(f"{words}: not in what is recorded in {folder}; there is\n{there}")


def whole_second(words: str) -> bool:
    """Whether no fraction is named: then all that came in that second is meant, as where the journal says the time."""
    return not re.search("[.,]", words)


def width(words: str) -> float:
    """Seconds that a time stands for: one of its fraction's last digit; 1 without one, for a minute or a date, too.

    So does a time that was printed, and cut, mean its cycle.
    """
    fraction = re.search("[.,]([0-9]+)", words)
    return whymoment.SECOND_S * 10.0 ** -min(0 if fraction is None else len(fraction[1]), DIGITS)


def meant(words: str, span: Span) -> list[float]:
    """The instants (UTC) that somebody may mean.

    A time of the day, on the days that the recording covers; a date with a time; local time unless it ends with Z or an
    offset. Or a number: of seconds since the recording began, or since the Unix epoch.

    Raises:
        NoMoment: it is no time.
    """
    text = words.strip().replace(",", ".")  # as half of the world writes a fraction, and ISO 8601 too
    if re.fullmatch(r"[0-9]+(\.[0-9]+)?", text):
        number = float(text)
        return [number if number > UNIX_S else span.begin + number]
    try:
        if told := re.fullmatch(r"(\d{1,2}:\d\d(?::\d\d(?:\.\d+)?)?)(Z|[+-]\d\d:?\d\d)?", text):
            of_day, offset = told.groups()
            zone = None if offset is None else datetime.strptime(offset, "%z").tzinfo
            first = datetime.fromtimestamp(span.begin, zone).astimezone(zone)
            days = int((span.end - span.begin) / 86400.0) + 2
            at = _time_of(of_day)
            midnight = first.replace(hour=0, minute=0, second=0, microsecond=0)
            return [(midnight + timedelta(days=day) + at).timestamp() for day in range(days)]
        return [datetime.fromisoformat(text).astimezone().timestamp()]  # without a zone: local time
    except (ValueError, OverflowError) as error:
        raise NoMoment(
            f"{words}: not a time; write 21:14:07, 2026-11-21T21:14:07Z, or seconds since the beginning"
        ) from error


def _time_of(text: str) -> timedelta:
    hours, minutes, *seconds = text.split(":")
    at = timedelta(hours=int(hours), minutes=int(minutes), seconds=float(seconds[0]) if seconds else 0.0)
    if int(hours) > 23 or int(minutes) > 59 or at >= timedelta(hours=int(hours), minutes=int(minutes) + 1):
        raise ValueError(text)
    return at


def moments(span: Span, utc: float) -> tuple[list[Moment], Rerun]:
    """Every cycle around an instant, replayed.

    Raises:
        HalError: the recording cannot be replayed.
    """
    t_mono = utc - span.utc_at_zero
    source = RecordingSource(span.path, until=t_mono - BEFORE_S)
    config = config_for(source, Config(), NOTHING_GIVEN)
    lights = lights_for(source, config, NOTHING_GIVEN)
    if lights is not None:
        warmup.load_aloud(cli.say, "warm-lights", partial(warmup.load, lights))
    rerun = Rerun(source, config, lights, None, start_for(source, config, lights, NOTHING_GIVEN))
    records: list[CycleRecord] = []
    rerun.watch = records.append
    told: list[Moment] = []
    shown = time.monotonic()
    for event in source.events():
        rerun.feed(event)
        if isinstance(event, Turn) and records:
            if event.t_mono >= t_mono - BEFORE_S:
                told.append(whymoment.moment_of(span.utc_at_zero, event.entry, records[-1], rerun.cycle))
            records.clear()
            if event.t_mono > t_mono + AFTER_S:
                break
            if time.monotonic() - shown > 5.0:
                cli.say(f"replaying, {max(0.0, t_mono - event.t_mono):.0f} s before it")
                shown = time.monotonic()
    rerun.finish()
    if not told or math.isinf(told[0].utc):
        raise NoMoment("no cycle was recorded around then")
    return told, rerun
