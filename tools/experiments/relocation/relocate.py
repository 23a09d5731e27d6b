"""Switched on, or carried away, anywhere in a building whose map is stored: right pose, AMBIGUOUS, or wrong?

A map is made by one drive and kept. Then robots are switched on at random places and headings, or carried there in
mid-run, at rest or slowly moving, half of them with somebody walking nearby. Five settings: a house under lamps; the
same in the dark; the house with lamps whose codes repeat from room to room; a room that is its own image when turned by
a quarter, lit and in the dark. Trials that are done are kept beside the maps, under a digest of the program they were
done with, so that a run that was broken off goes on where it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_snapshot import MapImage
from tools.ci.figures import Figure, bounded
from tools.experiments.relocation.maps import kept_map
from tools.experiments.relocation.trial import Case, Outcome, trial
from tools.experiments.relocation.worlds import Place, Site, lit_house, symmetric_room
from tools.experiments.support.proof import proved_share
from tools.experiments.support.report import COMMAND, Cell, Report, Table, Work, code
from tools.sim.ceiling.ceiling import Effects

FOLDER: Final = Path("out/experiments/relocate")
SEED: Final = 1
TRIALS: Final = 200
QUICK: Final = 4
FRAME_S: Final = 3.02
"""How long a lamp takes to tell what it is."""
SOURCES: Final = (
    "estimator/**/*.py",
    "daemon/integrity/state_machine.py",
    "daemon/integrity/observer.py",
    "tools/experiments/relocate*.py",
)


@dataclass(frozen=True, slots=True)
class Setting:
    """Where trials are made: a place, whether there is light, and which part of all trials it gets."""

    place: Callable[[], Place]
    lit: bool
    share: float
    seconds: float = 8.0


SETTINGS: Final = {
    "lit": Setting(lit_house, True, 1.0),
    "dark": Setting(lit_house, False, 1.0, 12.0),
    "codes reused": Setting(lambda: lit_house(reused=True), True, 0.5),
    "symmetric, dark": Setting(symmetric_room, False, 0.2, 12.0),
    "symmetric, lit": Setting(symmetric_room, True, 0.2),
}


@dataclass(frozen=True, slots=True)
class Task:
    """One trial of a setting."""

    setting: str
    seed: int


@cache
def site_of(name: str) -> tuple[Site, LightsSetup | None]:
    """Where a setting's trials are made; one for each process."""
    setting = SETTINGS[name]
    site = Site(setting.place(), Effects(), SEED)
    return site, LightsSetup(site.survey, clock_ppm=0.0) if setting.lit else None


@cache
def image_of(name: str) -> MapImage:
    """The setting's map."""
    site, lights = site_of(name)
    return kept_map(FOLDER / f"{file_name(name)}-{digest()}.map", site, lights)


def file_name(name: str) -> str:
    """A setting's name as part of a file's."""
    return name.replace(", ", "-").replace(" ", "-")


def digest() -> str:
    """Of the program that trials are made with."""
    return code(*SOURCES)


def attempt(task: Task) -> Outcome:
    """One trial."""
    site, lights = site_of(task.setting)
    carried, moving = bool(task.seed % 2), bool(task.seed // 2 % 2)
    case = Case(task.setting, carried, moving, SETTINGS[task.setting].seconds)
    return trial(site, image_of(task.setting), case, task.seed, lights)


def run(quick: bool, work: Work) -> Report:
    """All settings; with ``quick`` a few trials of the first two with whatever map half a minute gives."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    whole = work.trials or (QUICK if quick else TRIALS)
    outcomes: dict[str, list[Outcome]] = {}
    for name, setting in SETTINGS.items():
        image_of(name)
        tasks = [Task(name, seed) for seed in range(max(2, round(setting.share * whole)))]
        outcomes[name] = work.map(attempt, tasks, name, FOLDER / digest())
    rows = [row for name, found in outcomes.items() for row in rows_of(name, found)]
    late = [late_row(name, one) for name, found in outcomes.items() for one in found if is_late(name, one)]
    tables = [Table("Where am I?", HEAD, tuple(rows))]
    tables += [Table("Under lamps, one by one: those that were late or wrong", LATE_HEAD, tuple(late))] if late else []
    return Report(tuple(figures_of(outcomes)), tuple(tables), (), (SEED,), NOTES)


HEAD: Final = (
    "", "trials", "right in 1 s, %", f"in {FRAME_S + 1.0:.0f} s, %", "at the end, %", "not yet, %", "median s",
    "wrong at the end", "off > 1 m or 15 deg", "TRACKING wrongly", "longest s", "slowest job, ms",
)  # fmt: skip
NOTES: Final = (
    "right: 20 cm and 3 deg, from then on to the end; not yet: AMBIGUOUS or looked for at the end, which is honest",
    "times are since being switched on or put down, the first scan and the first epoch of light included; background "
    "jobs answer with the next scan (100 ms)",
    "carried: for 1.5 s, wheels standing still, between two places where a robot had been found or not",
    "TRACKING wrongly: more than 0.5 m or 5 deg off for longer than 0.5 s with light, 2 s without",
)


def allowed(name: str) -> float:
    """How long TRACKING may be wrong after a robot was carried off, s."""
    return 0.5 if SETTINGS[name].lit else 2.0


def rows_of(name: str, found: list[Outcome]) -> list[tuple[Cell, ...]]:
    """Lines of the table: switched on and carried, and where codes repeat, those in view of a set of their own."""
    parts: dict[str, list[Outcome]] = {}
    for one in found:
        parts.setdefault(key_of(name, one), []).append(one)
    return [row_of(key, part, name) for key, part in sorted(parts.items())]


def key_of(name: str, one: Outcome) -> str:
    """The line that an outcome belongs to."""
    how = "carried" if one.carried else "switched on"
    return f"{name}, {how}" + ("" if one.unique or not SETTINGS[name].lit else ", codes not unique")


def is_late(name: str, one: Outcome) -> bool:
    """Whether a trial under lamps is one that the bounds do not allow."""
    if not SETTINGS[name].lit:
        return False
    least = 1.0 if one.unique else FRAME_S + 1.0
    late = one.right_s is None or one.right_s > least
    return late or one.far_s > allowed(name) or one.astray_s > allowed(name)


LATE_HEAD: Final = ("", "seed", "moving", "lamps", "right after, s", "at the end", "off, m", "off > 1 m or 15 deg, s")


def late_row(name: str, one: Outcome) -> tuple[Cell, ...]:
    """A trial of its own, by whose seed it can be made again."""
    right = math.nan if one.right_s is None else one.right_s
    return (
        key_of(name, one), one.seed, "yes" if one.moving else "no", one.lamps, right, one.end, one.off_m, one.far_s,
    )  # fmt: skip


def row_of(title: str, found: list[Outcome], name: str) -> tuple[Cell, ...]:
    """A line of the table."""
    n = len(found)
    times = [one.right_s if one.right_s is not None else math.inf for one in found]
    known = [t for t in times if math.isfinite(t)]
    wrong = [one for one in found if not one.ended_right and one.end in GIVEN]
    return (
        title, n, 100.0 * sum(t <= 1.0 for t in times) / n, 100.0 * sum(t <= FRAME_S + 1.0 for t in times) / n,
        100.0 * len(known) / n, 100.0 * sum(one.end not in GIVEN for one in found) / n,
        float(np.median(known)) if known else math.nan, len(wrong), sum(one.far_s > allowed(name) for one in found),
        sum(one.astray_s > allowed(name) for one in found), max(one.astray_s for one in found),
        1e3 * max(one.job_s for one in found),
    )  # fmt: skip


GIVEN: Final = ("MAPPING", "TRACKING", "DEGRADED")


def figures_of(outcomes: dict[str, list[Outcome]]) -> list[Figure]:
    """What the project has bounds for."""
    out = []
    command = f"{COMMAND} relocate"
    for name, found in outcomes.items():
        one_of_a_kind = [one for one in found if one.unique]
        if SETTINGS[name].lit and one_of_a_kind:
            soon = sum(one.right_s is not None and one.right_s <= 1.0 for one in one_of_a_kind)
            share = 100.0 * soon / len(one_of_a_kind)
            out.append(bounded(f"{name}: right in 1 s where codes are unique", share, "%", ">= 99", command))
            found_in = [one for one in found if not one.unique]
            if found_in:
                soon = sum(one.right_s is not None and one.right_s <= FRAME_S + 1.0 for one in found_in)
                share = 100.0 * soon / len(found_in)
                out.append(bounded(f"{name}: right in a frame and 1 s elsewhere", share, "%", ">= 99", command))
        astray = sum(one.astray_s > allowed(name) for one in found)
        out.append(bounded(f"{name}: TRACKING wrongly, of {len(found)}", float(astray), "", "<= 0", command))
        far = sum(one.far_s > allowed(name) for one in found)
        out.append(bounded(f"{name}: off by > 1 m or 15 deg, of {len(found)}", float(far), "", "<= 0", command))
        most = 100.0 * proved_share(astray, len(found))
        out.append(Figure(f"{name}: TRACKING wrongly, less than (95 %)", most, "%", command=command))
    return out
