"""Match journal of a replay (`lumiloop replay --journal`): single matches with every iteration, as JSON and pictures.

docs/replay.md describes the format; a change of meaning changes :data:`VERSION`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.replay import match_plot
from daemon.replay.results import OutputRefused, written_rows, written_stamp
from daemon.system.extras import how_to_install
from estimator import (
    Array,
    Asked,
    Entry,
    LightSaid,
    MatchResult,
    Pairs,
    Reason,
    Scan,
    ScanPoints,
    State,
    Told,
    entry_of,
    icp,
    match_trace,
    scan_matcher,
)

FORMAT: Final = "lumiloop-match"
VERSION: Final = 1
MOST: Final = 100
"""Matches that may be requested by number in one run: each takes a few hundred kilobytes."""
MOST_FAILED: Final = 20
"""Failed matches that are written; further ones are only counted."""
FAILED: Final = "failed"
OURS: Final = re.compile(r"match-[1-9][0-9]*\.(json|png)")
"""Names of the written files."""

UNITS: Final = {"length": "m", "angle": "rad", "time": "s", "information": "1/m^2, 1/(m rad), 1/rad^2"}
FRAMES: Final = {
    "base": "REP-103 body frame at the scan's last beam: x forward, y left",
    "odom": "T_odom_base and the local map; never jumps",
    "keyframe": "body frame of the newest keyframe",
}


class BadChoice(Exception):
    """The value of ``--journal`` is invalid; the text gives the reason."""


@dataclass(slots=True)
class Choice:
    """Selection of matches, counted from 1 in the order in which they were made.

    Attributes:
        numbers: these. seconds: the first at or after each of these, since the log's first event. failed: those without
        a
            result.
    """

    numbers: frozenset[int] = frozenset()
    seconds: tuple[float, ...] = ()
    failed: bool = False


def choice_of(words: str | None, seconds: float | None) -> Choice:
    """Returns the selection given on the command line.

    Raises:
        BadChoice: not a list of numbers from 1, nor ``failed``; or more than :data:`MOST`.
    """
    if seconds is not None and not (math.isfinite(seconds) and seconds >= 0.0):
        raise BadChoice(f"--journal-at {seconds}: not a time; give seconds since the start of the log")
    parts = [part.strip() for part in words.split(",")] if words is not None else []
    numbers = [part for part in parts if part != FAILED]
    if not all(part.isdecimal() and int(part) > 0 for part in numbers):
        raise BadChoice(
            f"--journal {words}: not a list of matches; give numbers from 1, separated by commas, or {FAILED}"
        )
    if len(numbers) > MOST:
        raise BadChoice(f"--journal with {len(numbers)} numbers; at most {MOST} are possible in one run")
    times = () if seconds is None else (seconds,)
    return Choice(frozenset(int(part) for part in numbers), times, FAILED in parts)


@dataclass(frozen=True, slots=True)
class Named:
    """Identification of a match.

    Attributes:
        match: its number. seconds: of its scan, since the log's first event. pose, stamp: number of its pose among
            those of ``trajectory.tum``, from 1, and the stamp there; None if its cycle gave no pose.
    """

    match: int
    seconds: float
    pose: int | None
    stamp: float | None

    def __str__(self) -> str:
        """Text for the operator."""
        if self.pose is None:
            return f"match {self.match} (no pose)"
        return f"match {self.match} (pose {self.pose} of trajectory.tum, stamp {self.stamp:.6f})"


@dataclass(slots=True)
class MatchJournal:
    """Keeps the selected matches of a run as a few references each; they are evaluated only when written.

    Attributes:
        choice: the selection. kept: by number, with seconds since the log's first event. matches: their total number.
        failed: matches without a result; those beyond :data:`MOST_FAILED` are not kept.
        removed: files of an earlier run.
        rows: row of each kept match in the trajectories, if it gave a pose. Light alone gives poses too, so the row is
            not the match number.
    """

    choice: Choice
    kept: dict[int, tuple[float, Entry]] = field(default_factory=dict)
    matches: int = 0
    failed: int = 0
    rows: dict[int, int] = field(default_factory=dict)
    removed: int = 0
    _told: int = 0
    _t_first: float = math.nan
    _before: float = -math.inf

    def attach(self, state: State) -> None:
        """Installs the trace of every match in the estimator."""

        def told(scan: Scan, points: ScanPoints, asked: Asked | None, result: MatchResult) -> None:
            if self.wants(scan.t_end, result):
                entry = entry_of(state, scan, points, asked, result)
                self.kept[self.matches] = (scan.t_end - self._t_first, entry)

        state.journal = told

    def begins(self, t_mono: float) -> None:
        """Sets the instant of the log's first event, s."""
        self._t_first = t_mono

    def gave(self, row: int | None) -> None:
        """Notes the end of a cycle and the row of its pose in the trajectories; None: it gave no pose."""
        if self.matches > self._told and self.matches in self.kept and row is not None:
            self.rows[self.matches] = row
        self._told = self.matches

    def wants(self, t_mono: float, result: MatchResult) -> bool:
        """Counts a match; True if it is selected."""
        self.matches += 1
        at, before = t_mono - self._t_first, self._before
        self._before = at
        failed = not result.ok and result.reason is not Reason.NO_MAP
        self.failed += failed
        timed = any(before < second <= at for second in self.choice.seconds)
        wanted = self.choice.failed and failed and self.failed <= MOST_FAILED
        return wanted or timed or self.matches in self.choice.numbers

    def named(self, stamps: Array) -> list[Named]:
        """Returns the kept matches by number, with their identification in ``trajectory.tum``.

        ``stamps``: of the poses in order of arrival, s; the file has :func:`written_rows` of them.
        """
        rows = written_rows(stamps)
        line = {written_stamp(float(stamps[row])): 1 + at for at, row in enumerate(rows)}
        found = []
        for number, (seconds, _) in sorted(self.kept.items()):
            row = self.rows.get(number)
            stamp = None if row is None else written_stamp(float(stamps[row]))
            known = (None, None) if stamp is None else (line[stamp], stamp)
            found.append(Named(number, seconds, *known))
        return found

    def files(self, stamps: Array) -> Iterator[tuple[str, bytes]]:
        """Yields ``match-N.json`` and, with matplotlib, ``match-N.png`` of each; ``stamps`` as for `named`."""
        for name in self.named(stamps):
            number, entry = name.match, self.kept[name.match][1]
            told = match_trace.tell(entry.asked)
            yield f"match-{number}.json", (json.dumps(document(name, entry, told)) + "\n").encode()
            picture = match_plot.draw(str(name), entry, told)
            if picture is not None:
                yield f"match-{number}.png", picture

    def clear(self, folder: Path) -> None:
        """Removes the matches of an earlier run from ``folder``, and no other file.

        Raises:
            OutputRefused: one of them cannot be removed.
        """
        for path in sorted(folder.iterdir()):
            if not (OURS.fullmatch(path.name) and path.is_file()):
                continue
            try:
                path.unlink()
            except OSError as error:
                raise OutputRefused(f"cannot remove {path} of an earlier run: {error.strerror}") from error
            self.removed += 1

    def missed(self) -> bool:
        """True if matches were requested by number or time and none was found."""
        return not self.kept and bool(self.choice.numbers or self.choice.seconds)

    def sentences(self) -> list[str]:
        """Returns sentences for the operator on what was written and what was not."""
        said = [f"matches written: {len(self.kept)}" + self._cleared()]
        missing = sorted(n for n in self.choice.numbers if n > self.matches)
        if missing:
            said.append(f"no match {', '.join(map(str, missing))}; the log has {self.matches}")
        late = [f"{second:g} s" for second in self.choice.seconds if second > self._before]
        if late:
            said.append(f"no match at or after {', '.join(late)}")
        if self.choice.failed:
            said.append(f"{self.failed} matches failed" + self._beyond())
        if self.kept and not match_plot.available():
            said.append(f"no plots of matches: matplotlib is not installed ({how_to_install('plot')})")
        return said

    def _cleared(self) -> str:
        return f"; files of an earlier run removed: {self.removed}" if self.removed else ""

    def _beyond(self) -> str:
        return f"; the first {MOST_FAILED} of them are in the match trace" if self.failed > MOST_FAILED else ""


def document(name: Named, entry: Entry, told: tuple[Told, ...]) -> dict[str, Any]:
    """Returns all data of one match, ready for JSON."""
    scan, result = entry.scan, entry.result
    return {
        "format": FORMAT,
        "version": VERSION,
        "units": UNITS,
        "frames": FRAMES,
        **asdict(name),
        "scan": {"seq": scan.seq, "t_begin": scan.t_begin, "t_end": scan.t_end, "beams": len(scan.bearing_rad)},
        "result": {
            "ok": result.ok,
            "reason": result.reason.name,
            "text": result.reason.value,
            "T_odom_base": result.T_odom_base.tolist(),
            "correction": result.correction.tolist(),
            "information": result.information.tolist(),
            "known_axes": result.known_axes.tolist(),
            "inliers": result.inliers,
            "queries": result.queries,
            "iterations": result.iterations,
            "residual_m": result.residual_m,
        },
        "refusal": _refusal(entry, told),
        "points": _rounded(entry.points.xy),
        "asked": None if entry.asked is None else _asked(entry.asked),
        "attempts": [_attempt(one) for one in told],
        "light": None if entry.light is None else _light(entry.light),
    }


def _refusal(entry: Entry, told: tuple[Told, ...]) -> dict[str, Any] | None:
    """Returns evidence and thresholds of a rejected match; None for other outcomes."""
    judged = [one.attempt for one in told if one.attempt.demand is not None]
    if entry.asked is None or entry.result.reason is not Reason.REJECTED or not judged:
        return None
    best, local = judged[-1], entry.asked[1]
    assert best.demand is not None
    return {
        "share": best.share,
        "against": best.against(local),
        "held": scan_matcher.held(best, local, entry.asked[4]),
        "ways": [{"least_share": share, "most_against": most} for share, most in best.demand.ways],
        "least_held": best.demand.held,
    }


def _asked(asked: Asked) -> dict[str, Any]:
    view, local, prior, cap, settings = asked
    names = ("x", "y", "normal_x", "normal_y", "slope", "weight")
    return {
        "T_odom_base": prior.T.tolist(),
        "information": prior.L.tolist(),
        "T_base_lidar": view.T_base_lidar.tolist(),
        "noise_m": view.noise_m,
        "most_iterations": cap,
        "settings": asdict(settings),
        "map": {"columns": names, "elements": _rounded(local.elements[:, : len(names)]), "updates": local.updates},
    }


def _attempt(told: Told) -> dict[str, Any]:
    attempt = told.attempt
    return {
        "what": told.what,
        "T_odom_base": attempt.prior.T.tolist(),
        "found": attempt.T.tolist(),
        "points": _rounded(attempt.view.points),
        "settled": bool(attempt.sums[icp.SETTLED]),
        "iterations": [
            {
                "T_odom_base": one.T_odom_base.tolist(),
                "scale_m": one.row[icp.SCALE],
                "gate_m": one.row[icp.GATE],
                "every": int(one.row[icp.STRIDE]),
                "inliers": int(one.row[icp.FITTED]),
                "pairs": int(one.row[icp.PAIRED]),
                "weights": one.row[icp.WEIGHED],
                "squares_m2": one.row[icp.SQUARED],
                "step_sigmas": math.sqrt(max(0.0, one.row[icp.STEP2])),
                "damping": one.row[icp.DAMPED],
                "looked_up": int(one.row[icp.SOUGHT]),
                "pair": _pairs(one.pairs),
            }
            for one in told.iterations
        ],
    }


def _pairs(pairs: Pairs) -> dict[str, list[Any]]:
    return {
        "point": pairs.point.tolist(),
        "element": pairs.element.tolist(),
        "residual_m": _rounded(pairs.residual_m),
        "weight": _rounded(pairs.weight),
        "fits": pairs.fits.tolist(),
    }


def _light(said: LightSaid) -> dict[str, Any]:
    return {
        "fix": said.fix.name,
        "T_map_base": None if said.T_map_base is None else said.T_map_base.tolist(),
        "keyframe": said.keyframe,
        "lamps": [
            {
                "lamp_id": lamp.lamp_id,
                "code": lamp.code,
                "keyframe_xy": None if lamp.reference is None else lamp.reference.tolist(),
                "base_xy": lamp.present.tolist(),
                "residual_xy": None if lamp.residual is None else lamp.residual.tolist(),
                "log_strength": lamp.logarithm,
            }
            for lamp in said.lamps
        ],
    }


def _rounded(values: Array) -> list[Any]:
    """Rounds to micrometres and microradians; the inputs of further computation stay in full."""
    rounded: list[Any] = np.round(values, 6).tolist()
    return rounded
