"""How far a position from light is trusted before it enters the pose.

The `lights` filter reckons with errors that are new in every epoch; those of its model (walls, floor, lamps that lean)
are not, nor are those of a heading that without wheels it can only guess at, or of the distance from a row of lamps.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimator.linear3 import invert3, symmetric
from estimator.records import Array
from estimator.result import LightsResult

TRUST, YOUNG, YOUNG_M = 2.0, 6.0, 1.0
"""By how much the variance of a position from light is raised: always, because errors of the light model hang together
farther than it knows; and at the start, fading with the way driven (m), because gains and heading are being found: 8.0
times where it begins, 4.2 after 1 m, 2.8 after 2 m. In 26 starts under lamps the heading was off by 1.5, 1.4, 1.0 and
0.9 deg (rms) after 1, 2, 3 and 4 m, and said to be sure to 5.7, 3.1, 2.0 and 1.6 (docs/integrity.md)."""
UNGUIDED = 1.5
"""By how much that variance is raised further where no wheels tell `lights` how the robot moves."""
ANY_HEADING = math.pi**2 / 3.0
"""Variance of a heading that may be any, rad^2."""


def doubted(lights: LightsResult, known_m: float, wheels: bool = True) -> LightsResult:
    """The lights' result with less trust in it; no heading is less certain than one that may be any.

    ``known_m``: way since light last began to find its place. ``wheels``: it is told how the robot moves.
    """
    P, factor = doubted_covariance(lights, known_m, wheels)
    return replace(lights, covariance=P, gained=lights.gained / factor)


def doubted_covariance(lights: LightsResult, known_m: float, wheels: bool = True) -> tuple[Array, float]:
    """Its covariance alone (3x3; m^2, rad^2; map axes), and by how much it has been raised."""
    factor = TRUST + YOUNG * math.exp(-known_m / YOUNG_M)
    factor *= 1.0 if wheels else UNGUIDED
    P = lights.covariance * factor
    heading = float(P[2, 2])
    if heading > ANY_HEADING:
        most = math.sqrt(ANY_HEADING / heading)
        P[2] *= most
        P[:, 2] *= most
    return P, factor


def without_heading(lights: LightsResult) -> LightsResult:
    """The lights' result with a heading that may be any: its position corrects the pose's heading by the way."""
    P = lights.covariance.copy()
    P[2, :2] = P[:2, 2] = 0.0
    P[2, 2] = ANY_HEADING
    keep = invert3(P) @ lights.covariance
    made = np.array((lights.gained_by[0], lights.gained_by[1], 0.0))
    return replace(lights, covariance=P, gained=symmetric(keep @ lights.gained @ keep.T), gained_by=made)


def across_the_row(more: Array, lights: LightsResult) -> LightsResult:
    """The lights' result, trusted less across the row in which all lamps in use stand, or have stood until lately.

    ``more``: covariance (3, 3; m, m, rad; survey axes) that is added, see `row.doubt` and `row.Lately`.
    """
    if not more.any():
        return lights
    P = lights.covariance + more
    keep = invert3(P) @ lights.covariance
    made = keep.T @ lights.gained_by  # what is told must go with what it weighs: else each wander across adds up
    return replace(lights, covariance=P, gained=symmetric(keep @ lights.gained @ keep.T), gained_by=made)
