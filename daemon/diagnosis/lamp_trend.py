"""Lamp ageing: level, trend and replacement date of each lamp from its gain history.

By convention a lamp's life ends at seven tenths of its initial light (L70, IES LM-80 and TM-21). The trend is a line
through ln of the power, weighted by the variance of each entry. A change common to all lamps may be dust on the
receiver or ageing. It is therefore reported for all together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.diagnosis.lamp_history import DAY_S
from daemon.snapshot import LinkUse

Array = npt.NDArray[np.float64]

END: Final = math.log(0.7)
YEAR_S: Final = 365.25 * DAY_S
SOON_S: Final = 60 * DAY_S
FURTHEST_S: Final = 20 * YEAR_S
LEAST_SPAN_S: Final = 14 * DAY_S
LEAST_LOOKS: Final = 4
SURE: Final = 2.0
"""Sigmas by which a trend must differ from zero."""
OWN_SIGMA: Final = 0.01
"""Additional sigma of an entry: people, other lamps switched off, the weather."""
JUMP, JUMP_SIGMAS = 0.25, 4.0
"""Change between two entries, ln, and in sigmas, that is too large for ageing."""
UNHEARD_S: Final = 7 * DAY_S
"""Time without a change, s, while most other lamps' values changed, after which a lamp was not received."""


class Finding(Enum):
    """Condition of a lamp, the gravest first."""

    DEAD = "is not received where it is expected: defective, off, or covered"
    MOVED = "differs from its survey: moved, exchanged, or its code is in use twice"
    CHANGED = "has changed suddenly: exchanged, cleaned, or displaced"
    UNHEARD = "has not been received recently, but others have"
    WORN = "has decreased to 70 % of its power"
    DIMMING = "is dimming"
    GOOD = "is unchanged"
    YOUNG = "has too short a history"


URGENT: Final = (Finding.DEAD, Finding.MOVED, Finding.WORN)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Condition of one lamp.

    Attributes:
        level: present power over the surveyed one. per_year: relative change, with sigma; None: not known.
        replace_by, earliest: UTC, s, at which it reaches seven tenths: the expected time, and the earliest (97 %); None
        if
            that is far off. since: UTC of the condition, s, where it has a time.
    """

    lamp: int
    finding: Finding
    level: float = 1.0
    per_year: float | None = None
    sigma: float = 0.0
    replace_by: float | None = None
    earliest: float | None = None
    since: float | None = None

    @property
    def urgent(self) -> bool:
        """True if the lamp needs attention soon."""
        return self.finding in URGENT


def judge(lamps: Mapping[int, Array], now: float, uses: Mapping[int, int] | None = None) -> list[Verdict]:
    """Returns the condition of every lamp at ``now`` (UTC, s), the gravest first.

    ``lamps``: histories by lamp ID, rows (utc, ln gain, sigma). ``uses``: present use of each lamp by a running daemon.
    """
    uses = {} if uses is None else uses
    heard = {lamp: _last_change(rows) for lamp, rows in lamps.items()}
    newest = max((float(rows[-1, 0]) for rows in lamps.values()), default=now)
    moving = np.mean([newest - at < UNHEARD_S for at in heard.values()]) if heard else 0.0
    verdicts = []
    for lamp in sorted({*lamps, *uses}):
        verdict = _by_history(lamp, lamps[lamp], now) if lamp in lamps else Verdict(lamp, Finding.YOUNG)
        if lamp in heard and moving > 0.5 and newest - heard[lamp] >= UNHEARD_S and len(lamps[lamp]) > 1:
            verdict = replace(verdict, finding=Finding.UNHEARD, since=heard[lamp])
        if uses.get(lamp) == LinkUse.MISSING:
            verdict = replace(verdict, finding=Finding.DEAD)
        elif uses.get(lamp) == LinkUse.REJECTED:
            verdict = replace(verdict, finding=Finding.MOVED)
        verdicts.append(verdict)
    order = list(Finding)
    return sorted(verdicts, key=lambda one: (order.index(one.finding), one.replace_by or math.inf, one.lamp))


def together(verdicts: list[Verdict]) -> float | None:
    """Returns the median relative change a year of all lamps; None if too few have a trend."""
    trends = [one.per_year for one in verdicts if one.per_year is not None]
    return float(np.median(trends)) if len(trends) >= LEAST_LOOKS else None


def _last_change(rows: Array) -> float:
    """Returns the UTC of the last change of the value, s; that of the first entry if it never changed."""
    changed = np.flatnonzero(np.abs(np.diff(rows[:, 1])) > 1e-6)
    return float(rows[changed[-1] + 1 if len(changed) else 0, 0])


def _by_history(lamp: int, rows: Array, now: float) -> Verdict:
    jump = _jump(rows)
    after = rows if jump is None else rows[jump:]
    level = math.exp(float(after[-1, 1]))
    young = Verdict(lamp, Finding.YOUNG if jump is None else Finding.CHANGED, level)
    young = young if jump is None else replace(young, since=float(rows[jump, 0]))
    if len(after) < LEAST_LOOKS or after[-1, 0] - after[0, 0] < LEAST_SPAN_S:
        worn = math.log(level) + SURE * float(after[-1, 2]) < END
        return replace(young, finding=Finding.WORN) if worn else young
    offset, slope, sigma = _line(after, now)
    told = Verdict(lamp, Finding.GOOD, math.exp(offset), math.expm1(slope * YEAR_S), sigma * YEAR_S)
    if offset <= END:
        return replace(told, finding=Finding.WORN, replace_by=now, earliest=now)
    if slope + SURE * sigma >= 0.0:
        return told if jump is None else replace(told, finding=Finding.CHANGED, since=float(rows[jump, 0]))
    left, least = (END - offset) / slope, (END - offset) / (slope - SURE * sigma)
    if left > FURTHEST_S:
        return replace(told, finding=Finding.DIMMING)
    return replace(told, finding=Finding.DIMMING, replace_by=now + left, earliest=now + least)


def _jump(rows: Array) -> int | None:
    """Returns the index of the entry after the last jump; None without one."""
    step = np.abs(np.diff(rows[:, 1]))
    doubt = np.hypot(rows[1:, 2], rows[:-1, 2])
    found = np.flatnonzero((step > JUMP) & (step > JUMP_SIGMAS * doubt))
    return int(found[-1]) + 1 if len(found) else None


def _line(rows: Array, now: float) -> tuple[float, float, float]:
    """Returns ln gain at ``now``, its slope per second, and the slope's sigma; residual scatter inflates the sigma."""
    t, y = rows[:, 0] - now, rows[:, 1]
    weight = 1.0 / (rows[:, 2] ** 2 + OWN_SIGMA**2)
    middle = float(np.average(t, weights=weight))
    spread = float(np.sum(weight * (t - middle) ** 2))
    level = float(np.average(y, weights=weight))
    slope = float(np.sum(weight * (t - middle) * (y - level))) / spread
    rest = y - level - slope * (t - middle)
    scatter = max(1.0, float(np.sum(weight * rest**2)) / max(1, len(y) - 2))
    return level - slope * middle, slope, math.sqrt(scatter / spread)
