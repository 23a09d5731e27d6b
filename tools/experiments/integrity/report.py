"""What the tracks of the integrity runs show: wrong states, errors beyond bound and covariance, how often it tracks."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.snapshot import State
from tools.experiments.integrity.run import COLUMNS
from tools.experiments.integrity.scene import SETTLED_S
from tools.experiments.support.proof import proved_share
from tools.experiments.support.report import Cell

Array = npt.NDArray[np.float64]

WRONG_M: Final = 0.5
WRONG_RAD: Final = np.radians(5.0)
LIT_S: Final = 0.5
UNLIT_S: Final = 2.0
"""For longer than this a wrong TRACKING counts, with light and with the laser alone."""
GAP_S: Final = 0.35
"""Cycles farther apart than this do not belong to one stretch."""
SIGMAS: Final = 5.0

KIND_HEAD: Final = (
    "kind", "runs", "wrong", "TRACKING, %", "of recoverable time, %", "cycles beyond 5 sigma", "beyond the bound",
    "of cycles",
)  # fmt: skip

_AT: Final = {name: number for number, name in enumerate(COLUMNS)}


@dataclass(slots=True)
class Found:
    """One scenario's outcome.

    Attributes:
        wrong_s: longest stretch of wrong TRACKING. limit_s: what is allowed. worst_m, worst_deg: in TRACKING.
        tracking, recoverable: share of the time after the start, and of that in which the place could be known.
        beyond_sigma, beyond_bound, bounded, tracked: cycles. means: what the robot has: lamps, wheels.
    """

    name: str
    clean: bool
    wrong_s: float
    limit_s: float
    worst_m: float
    worst_deg: float
    tracking: float
    recoverable: float
    recoverable_n: int
    beyond_sigma: int
    beyond_bound: int
    bounded: int
    tracked: int
    facts: str
    means: str

    @property
    def wrong(self) -> bool:
        """TRACKING was said of a wrong place for longer than is allowed."""
        return self.wrong_s > self.limit_s


@dataclass(slots=True)
class Summary:
    """All of them, and every cycle's error with what was said of it (rows of :data:`COLUMNS`)."""

    found: list[Found] = field(default_factory=list)
    cycles: list[Array] = field(default_factory=list)

    @property
    def wrong(self) -> int:
        """Scenarios in which TRACKING was said of a wrong place."""
        return sum(each.wrong for each in self.found)

    def kinds(self) -> tuple[tuple[Cell, ...], ...]:
        """Rows of :data:`KIND_HEAD`."""
        rows: list[tuple[Cell, ...]] = []
        for kind in dict.fromkeys(each.name.rpartition("-")[0] for each in self.found):
            own = [each for each in self.found if each.name.rpartition("-")[0] == kind]
            weights = sum(each.recoverable_n for each in own)
            recovered = sum(each.recoverable * each.recoverable_n for each in own) / weights if weights else np.nan
            shares = 100.0 * float(np.mean([e.tracking for e in own])), 100.0 * float(recovered)
            counts = (sum(e.beyond_sigma for e in own), sum(e.beyond_bound for e in own), sum(e.bounded for e in own))
            rows.append((kind, len(own), sum(e.wrong for e in own), *shares, *counts))
        return tuple(rows)

    def figures(self) -> list[str]:
        """Single numbers, as sentences."""
        n = len(self.found)
        if not n:
            return ["no tracks"]
        clean = [each.tracking for each in self.found if each.clean]
        weights = sum(each.recoverable_n for each in self.found)
        recovered = sum(each.recoverable * each.recoverable_n for each in self.found) / max(weights, 1)
        told = np.concatenate(self.cycles) if self.cycles else np.zeros((0, len(COLUMNS)))
        told = told[told[:, _AT["state"]] == State.TRACKING]
        error, sigma = np.median(told[:, _AT["error_m"]]), np.median(told[:, _AT["sigma_m"]])
        turned, spread = np.median(told[:, _AT["error_rad"]]), np.median(told[:, _AT["sigma_rad"]])
        return [
            f"wrong: {self.wrong} of {n}: at most {proved_share(self.wrong, n):.2%} of scenarios like these (95 %)",
            f"TRACKING in clean drives {np.mean(clean) if clean else np.nan:.1%}, of recoverable time {recovered:.1%}",
            f"median error {100 * error:.1f} cm, median sigma {100 * sigma:.1f} cm ({sigma / error:.2f} times); "
            f"heading {np.degrees(turned):.2f} deg, {np.degrees(spread):.2f} deg ({spread / turned:.2f} times)",
            *self._by_means(),
        ]  # fmt: skip

    def _by_means(self) -> list[str]:
        """Of each equipment: clean drives, and how far what is said of the error is true of it.

        Of independent errors along two equal axes 86.5 % are within two deviations; along one axis 95.4 %.
        """
        lines = []
        for means in sorted({each.means for each in self.found}):
            own = [(each, track) for each, track in zip(self.found, self.cycles, strict=True) if each.means == means]
            clean = [each.tracking for each, _ in own if each.clean]
            rows = np.concatenate([track for _, track in own])
            rows = rows[rows[:, _AT["state"]] == State.TRACKING]
            if not len(rows):
                continue
            error, sigma = rows[:, _AT["error_m"]], rows[:, _AT["sigma_m"]]
            share = f"{np.mean(clean):.1%} of {len(clean)}" if clean else "none"
            lines.append(
                f"  {means}: TRACKING in clean drives {share}; median error {100 * np.median(error):.1f} cm, sigma "
                f"{100 * np.median(sigma):.1f} cm; within two sigmas {np.mean(error <= 2.0 * sigma):.1%}, three "
                f"{np.mean(error <= 3.0 * sigma):.1%}"
            )
        return lines


def report(out: Path, kinds: Iterable[str]) -> Summary:
    """Read all kept tracks of some kinds."""
    made = Summary()
    for kind in kinds:
        for path in sorted(out.glob(f"{kind}-*.npz"), key=lambda path: int(path.stem.rpartition("-")[2])):
            with np.load(path) as kept:
                track, spans = kept["track"].astype(np.float64), kept["recoverable"]
                made.found.append(
                    judged(path.stem, track, spans, (bool(kept["lit"]), bool(kept["clean"]), str(kept["facts"])))
                )
            made.cycles.append(track)
    return made


def judged(name: str, track: Array, recoverable: Array, facts: tuple[bool, bool, str]) -> Found:
    """The outcome of one track; ``facts``: lit, clean, what else is known of it."""
    t, error, turned = (track[:, _AT[key]] for key in ("t", "error_m", "error_rad"))
    tracked = track[:, _AT["state"]] == State.TRACKING
    off = tracked & ((error > WRONG_M) | (turned > WRONG_RAD))
    bounded = np.isfinite(track[:, _AT["bound_m"]])
    beyond = bounded & ((error > track[:, _AT["bound_m"]]) | (turned > track[:, _AT["bound_rad"]]))
    counted = t >= SETTLED_S
    could = np.zeros(len(t), bool)
    for since, until in recoverable:
        could |= (t >= since) & (t < until)
    lit, clean, said = facts
    return Found(
        name=name,
        clean=clean,
        wrong_s=longest(t, off),
        limit_s=LIT_S if lit else UNLIT_S,
        worst_m=float(error[tracked].max(initial=0.0)),
        worst_deg=float(np.degrees(turned[tracked].max(initial=0.0))),
        tracking=float(tracked[counted].mean()) if counted.any() else 0.0,
        recoverable=float(tracked[could].mean()) if could.any() else 0.0,
        recoverable_n=int(could.sum()),
        beyond_sigma=int((tracked & (track[:, _AT["deviations"]] > SIGMAS)).sum()),
        beyond_bound=int(beyond.sum()),
        bounded=int(bounded.sum()),
        tracked=int(tracked.sum()),
        facts=said,
        means=means_of(said),
    )


def means_of(facts: str) -> str:
    """What a robot tells its place by, from the facts of its scenario."""
    known = ast.literal_eval(facts or "{}")
    return f"{'lit' if known.get('lit') else 'laser only'}, {'with' if known.get('wheels') else 'without'} wheels"


def longest(t: Array, on: npt.NDArray[np.bool_]) -> float:
    """Seconds of the longest unbroken stretch; a single cycle is none."""
    best, since, before = 0.0, None, -np.inf
    for now, is_on in zip(t.tolist(), on.tolist(), strict=True):
        if not is_on or now - before > GAP_S:
            since = now if is_on else None
        elif since is None:
            since = now
        before = now
        if since is not None:
            best = max(best, now - since)
    return best
