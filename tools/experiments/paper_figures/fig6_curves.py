"""Precision and recall of detections under any set of conditions and any thresholds (definitions: fig6_truth)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimator.mapping.loop_verification import Condition, Found, LoopSettings, foremost, passed
from tools.experiments.paper_figures.fig6_trial import Detection, Drive
from tools.experiments.paper_figures.fig6_truth import RIGHT

THRESHOLDS_M: Final = (0.004, 0.005, 0.0055, 0.006, 0.0065, 0.007, 0.0075, 0.008, 0.009, 0.01, 0.012, 0.015, 0.02, 0.06)
SHARES: Final = (0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
STEPS: Final = (Condition.SSE, Condition.RANK, Condition.OVERLAP, Condition.AGAINST, Condition.LIGHT, Condition.IDS)
"""In the order in which they are added."""
WORDS: Final = {
    Condition.SSE: "SSE", Condition.RANK: "rank", Condition.OVERLAP: "overlap", Condition.AGAINST: "against",
    Condition.LIGHT: "light gate", Condition.IDS: "IDs",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Rule:
    """What is accepted: thresholds and conditions; without light its starts and its judgements do not exist."""

    settings: LoopSettings
    lit: bool


@dataclass(frozen=True, slots=True)
class Point:
    """Precision (1 where nothing is accepted), recall, and of how many."""

    accepted: int
    right: int
    queries: int
    got: int

    @property
    def precision(self) -> float:
        """Right detections by all."""
        return self.right / self.accepted if self.accepted else 1.0

    @property
    def recall(self) -> float:
        """Queries that got a right detection, by those that have a near positive."""
        return self.got / self.queries if self.queries else math.nan

    @property
    def f1(self) -> float:
        """Harmonic mean of both."""
        return 2.0 * self.precision * self.recall / max(self.precision + self.recall, 1e-9)


def rule(steps: int, lit: bool, sse_m: float = 0.06, share: float | None = None) -> Rule:
    """The first so many conditions."""
    told = LoopSettings(conditions=frozenset(STEPS[:steps]), sse_m=sse_m)
    return Rule(told if share is None else replace(told, share=share), lit)


def right(one: Detection, within: tuple[float, float] = RIGHT) -> bool:
    """Whether a detection is a true one."""
    return one.positive and one.off_m <= within[0] and one.off_rad <= within[1]


def accepted(drive: Drive, asked: Rule) -> list[Detection]:
    """Of the places looked at without a guess, those that a rule accepts: one for each keyframe and submap, at most.

    With lights, a keyframe whose links are paused closes nothing here: with no idea of the place, laser alone may not.
    """
    groups: dict[tuple[int, int], list[Detection]] = {}
    for one in drive.anywhere:
        paused = math.isnan(one.light)
        if (not asked.lit and one.by_light) or (asked.lit and Condition.LIGHT in asked.settings.conditions and paused):
            continue
        groups.setdefault((one.query, one.submap), []).append(one)
    kept = []
    for group in groups.values():
        pairs = [(as_found(one), one) for one in group]
        pairs = [(found, one) for found, one in pairs if passed(found, asked.settings)]
        chosen = foremost([found for found, _ in pairs], asked.settings)
        kept += [one for found, one in pairs if found is chosen]
    return kept


def as_found(one: Detection) -> Found:
    """A detection as the closer judges it; without a pose's guess there is no condition on it."""
    light = None if math.isnan(one.light) else one.light
    T, nothing = np.array(one.place), np.zeros((3, 3))
    return Found(
        one.submap, T, nothing, one.share, one.against, one.residual_m, T, known=one.known, light=light,
        shared=one.shared,
    )  # fmt: skip


def point(drives: Iterable[Drive], asked: Rule) -> Point:
    """Precision and recall over drives, of places looked at without a guess."""
    total = np.zeros(4, int)
    for drive in drives:
        total += counted(accepted(drive, asked), drive.queries)
    return Point(*total.tolist())


def counted(found: list[Detection], queries: dict[int, bool]) -> tuple[int, int, int, int]:
    """Accepted, right, queries with a near positive, and those of them that got a right detection."""
    true = [one for one in found if right(one)]
    asked = {key for key, positive in queries.items() if positive}
    return len(found), len(true), len(asked), len(asked & {one.query for one in true})


def clear(drive: Drive) -> Drive:
    """The same drive, asked only about keyframes of which light could say something."""
    told = {one.query for one in drive.anywhere if not math.isnan(one.light)}
    return replace(drive, queries={key: positive for key, positive in drive.queries.items() if key in told})


def best(points: Iterable[Point], precision: float) -> float:
    """Largest recall of a curve at that precision or better, NaN where it never gets there."""
    return max((one.recall for one in points if one.accepted and one.precision >= precision), default=math.nan)
