"""Recordings and dumps by the time that they cover, and the search for the one with a given moment."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final

from daemon.diagnosis import moment
from daemon.diagnosis import utc as diagnosis_utc
from daemon.replay.sources import RecordingSource
from daemon.system import console
from daemon.system.versions import made_elsewhere
from hal.errors import DataInvalid, DeviceMissing
from hal.replay.recording import SUFFIX, Recording, open_recording
from hal.replay.report import LogReport
from hal.replay.text import unreadable

BEFORE_S, AFTER_S = 20.0, 5.0
"""Replayed time before and after the moment, s."""
UNIX_S: Final = 1e8
"""A larger number of seconds counts from the Unix epoch, a smaller one from the start of the recording."""
DIGITS: Final = 6
"""Decimals of a second beyond which times are not distinguished."""


class NoMoment(Exception):
    """No recording contains the moment; the text lists what there is."""


@dataclass(frozen=True, slots=True)
class Span:
    """A recording, or its part between two steps of the clock, and the time (UTC, s) that it covers.

    Attributes:
        utc_at_zero: UTC at zero of its monotonic clock, s. made: software that made it, empty if it is the present one.
        before_s: duration of the recording before this part, s.
        came, gone: step of the clock at its begin and end, s; 0: none.
    """

    path: Path
    begin: float
    end: float
    utc_at_zero: float
    made: str = ""
    before_s: float = 0.0
    came: float = 0.0
    gone: float = 0.0

    @property
    def remarks(self) -> str:
        """Lines to print before the report; may be empty."""
        clock = diagnosis_utc.said(self.begin, self.came, self.end, self.gone)
        return "\n".join([*([self.made] if self.made else []), *clock])


def spans(folder: Path) -> list[Span]:
    """Returns the recordings and dumps in a folder, or the one that it is, in order; split where the clock was set.

    Raises:
        HalError: it cannot be read, or there is none.
    """
    try:
        if not (is_folder(folder) or folder.exists()):
            raise DeviceMissing(str(folder), "no such folder", "name a recording, a dump, or a folder of several")
        inside = sorted(path for path in folder.iterdir() if path.is_dir()) if is_folder(folder) else []
    except OSError as error:
        raise unreadable(folder, error) from error
    runs = [path for path in inside if any(path.glob(f"*{SUFFIX}"))] or [folder]
    found = []
    for path in runs:
        try:
            found += _spans(path)
        except (DataInvalid, DeviceMissing) as error:  # an active ring removes segments meanwhile
            if len(runs) == 1:
                raise
            console.say(f"{error}; this folder is ignored")
    return found


def is_folder(path: Path) -> bool:
    """True if there is a folder; raises `HalError` if access is denied, as to the service's own folder."""
    try:
        return path.is_dir()
    except OSError as error:
        raise unreadable(path, error) from error


def _spans(path: Path) -> list[Span]:
    recording = open_recording(path)
    source = RecordingSource(path)
    begun = _begun(path, recording.header)
    begin = begun[0] if source.begin is None else source.begin.t_mono
    end = max(begin, _end(recording, begin))
    parts = [part for part in diagnosis_utc.parts(path, source.files, begun, begin) if part.t_mono <= end]
    ends = [*(part.t_mono for part in parts[1:]), end]
    steps = [*(part.step for part in parts[1:]), 0.0]
    made = made_elsewhere(recording.header)
    return [
        Span(
            path,
            begin=round(part.utc_at_zero + part.t_mono, 6),
            end=round(part.utc_at_zero + until, 6),
            utc_at_zero=part.utc_at_zero,
            made=made,
            before_s=part.t_mono - begin,
            came=part.step,
            gone=gone,
        )
        for part, until, gone in zip(parts, ends, steps, strict=True)
    ]


def _end(recording: Recording, begin: float) -> float:
    """Time of the last record, s; a kill or a power cut may leave a segment without any record, or without a head."""
    for segment in reversed(recording.segments):
        last = replace(recording, segments=(segment,)).frames(LogReport())
        if (end := max((frame.t_mono for frame in last), default=None)) is not None:
            return end
    return begin


def _begun(path: Path, header: dict[str, Any]) -> diagnosis_utc.Pair:
    """Returns the start of a run by its monotonic clock and in UTC, both in s."""
    if not {"t_mono", "t_utc"} <= header.keys():
        problem = "its head has no start time, so times cannot be found in it"
        raise DataInvalid(str(path), problem, "replay the whole recording: lumiloop replay")
    if (pair := diagnosis_utc.pair_of(header["t_mono"], header["t_utc"])) is None:
        raise DataInvalid(
            str(path), "its head has an invalid start time", "replay the whole recording: lumiloop replay"
        )
    return pair


def find(recorded: list[Span], words: str, folder: Path) -> tuple[Span, float, float]:
    """Returns the recording that contains a moment, and the time of the moment.

    Returns:
        The recording with most of the time before it; the moment (UTC, s), to the microsecond; and its duration, s,
        more than 0. If only a part of a whole second is recorded, it is that part. If a clock was set back, a time
        occurs twice in a recording; the later one is used.

    Raises:
        NoMoment: no recording contains it, or ``words`` is no time.
    """
    wide = width(words)
    asked = [(span, round(utc, 6), round(utc + wide, 6)) for span in recorded for utc in meant(words, span)]
    here = [
        (span, begin, round(end - begin, 6), begin == utc)
        for span, utc, end in asked
        if utc <= span.end and (begin := max(utc, span.begin)) < end
    ]
    if here:
        # Of one recording's parts, use the one with the time's begin; of several such parts, the latest.
        part = {one[0].path: one[0] for one in sorted(here, key=lambda one: one[3])}
        there = [one for one in here if one[0] is part[one[0].path]]
        return max(there, key=_has_before)[:3]
    raise NoMoment(
        f"{words}: no recording in {folder} covers this time; available:\n" + "\n".join(map(_listed, recorded))
    )


def _has_before(found: tuple[Span, float, float, bool]) -> tuple[float, float]:
    """Sort key of a recording: recorded time before the moment, then the latest."""
    span, begin, *_ = found
    return min(begin - span.begin + span.before_s, BEFORE_S), span.begin - span.before_s


def _listed(span: Span) -> str:
    """Returns a line on a recording."""
    came = f", after a clock step of {span.came:+.3f} s" if span.came else ""
    begin, end = moment.clock(span.begin), moment.clock(span.end)
    return f"  {begin} to {end}, {span.end - span.begin:.0f} s  {span.path.name}{came}"


def whole_second(words: str) -> bool:
    """True if the time has no fraction; it then means the whole second, as in the journal."""
    return not re.search("[.,]", words)


def width(words: str) -> float:
    """Returns the duration that a time stands for, s: one unit of its fraction's last digit.

    Without a fraction it is 1, also for a minute or a date. A time that was printed and truncated thus still selects
    its cycle.
    """
    fraction = re.search("[.,]([0-9]+)", words)
    return moment.SECOND_S * 10.0 ** -min(0 if fraction is None else len(fraction[1]), DIGITS)


def meant(words: str, span: Span) -> list[float]:
    """Returns the instants (UTC, s) that a text may mean.

    It is a time of the day, on each day that the recording covers; or a date with a time. Both are local time unless
    they end with Z or an offset; one hour of a night occurs twice when clocks are put back. Or it is a number of
    seconds since the start of the recording, or since the Unix epoch.

    Raises:
        NoMoment: it is no time.
    """
    text = words.strip().replace(",", ".")  # a decimal comma, which ISO 8601 permits too
    if re.fullmatch(r"[0-9]+(\.[0-9]+)?", text):
        number = float(text)
        return [number if number > UNIX_S else span.begin - span.before_s + number]
    try:
        if told := re.fullmatch(r"(\d{1,2}:\d\d(?::\d\d(?:\.\d+)?)?)(Z|[+-]\d\d:?\d\d)?", text):
            of_day, offset = told.groups()
            zone = None if offset is None else datetime.strptime(offset, "%z").tzinfo
            first, last = (datetime.fromtimestamp(utc, zone) for utc in (span.begin, span.end))
            midnight = first.replace(hour=0, minute=0, second=0, microsecond=0, fold=0)
            days = [midnight + timedelta(days=day) for day in range((last.date() - first.date()).days + 1)]
            return [utc for day in days for utc in _instants(day + _time_of(of_day))]
        return _instants(datetime.fromisoformat(text))
    except (ValueError, OverflowError) as error:
        raise NoMoment(
            f"{words}: not a time; give 21:14:07, 2026-11-21T21:14:07Z, or seconds since the start"
        ) from error


def _instants(at: datetime) -> list[float]:
    """Returns the instants (UTC, s) of a date and time; without a zone, local time, which may occur twice or never."""
    if at.tzinfo is not None:
        return [at.timestamp()]
    found = (at.replace(fold=fold).astimezone() for fold in (0, 1))
    utc = dict.fromkeys(local.timestamp() for local in found if local.replace(tzinfo=None, fold=0) == at)
    return list(utc)


def _time_of(text: str) -> timedelta:
    hours, minutes, *seconds = text.split(":")
    at = timedelta(hours=int(hours), minutes=int(minutes), seconds=float(seconds[0]) if seconds else 0.0)
    if int(hours) > 23 or int(minutes) > 59 or at >= timedelta(hours=int(hours), minutes=int(minutes) + 1):
        raise ValueError(text)
    return at
