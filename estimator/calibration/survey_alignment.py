"""Alignment of a drive's frame to the lamp survey: lamps located by the drive matched to surveyed lamps by code."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Final

import numpy as np

from estimator.light_filter.survey import Lamp, Survey
from estimator.numerics.arrays import Array

FITS_M: Final = 0.5
"""Largest distance (m) between a located lamp and its surveyed one; both are good to decimetres."""


class Unaligned(ValueError):
    """Too few lamps, or none that agree; the message names which."""


def align(survey: Survey, located: Survey) -> Array:
    """T_survey_drive (x, y, yaw) that brings the most located lamps onto surveyed ones of their code.

    Every pair of lamps of two codes proposes a transform. The one with the most matching lamps is refined by all of
    these (closed form, Eq. 13 of the paper).

    Raises:
        Unaligned: fewer than two lamps agree.
    """
    pairs = [(a, b) for a in located.lamps for b in survey.lamps if a.code == b.code]
    best: list[tuple[Lamp, Lamp]] = []
    for one, other in combinations(pairs, 2):
        if one[0] is other[0] or one[1] is other[1]:
            continue
        apart = _apart(one[0], other[0]), _apart(one[1], other[1])
        if abs(apart[0] - apart[1]) > FITS_M or min(apart) < FITS_M:
            continue
        behind = _behind(closed([one, other]), pairs)
        if len(behind) > len(best):
            best = behind
    if len(best) < 2:
        raise Unaligned(
            f"{len(located.lamps)} lamps were located and {len(survey.lamps)} are surveyed, but no two of them agree"
        )
    return closed(best)


def closed(pairs: list[tuple[Lamp, Lamp]]) -> Array:
    """Least-squares transform (x, y, yaw) over pairs (located, surveyed)."""
    q = np.array([(a.x, a.y) for a, _ in pairs])
    p = np.array([(b.x, b.y) for _, b in pairs])
    dq, dp = q - q.mean(axis=0), p - p.mean(axis=0)
    yaw = math.atan2(float((dq[:, 0] * dp[:, 1] - dq[:, 1] * dp[:, 0]).sum()), float((dq * dp).sum()))
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = p.mean(axis=0) - np.array(((c, -s), (s, c))) @ q.mean(axis=0)
    return np.array((x, y, yaw))


def _behind(T: Array, pairs: list[tuple[Lamp, Lamp]]) -> list[tuple[Lamp, Lamp]]:
    """Pairs that a transform brings within `FITS_M` of each other."""
    c, s = math.cos(T[2]), math.sin(T[2])
    return [
        (a, b) for a, b in pairs if math.hypot(T[0] + c * a.x - s * a.y - b.x, T[1] + s * a.x + c * a.y - b.y) < FITS_M
    ]


def _apart(a: Lamp, b: Lamp) -> float:
    """Horizontal distance of two lamps, m."""
    return math.hypot(a.x - b.x, a.y - b.y)
