"""How far a position from light is trusted before it enters the pose.

The `lights` filter reckons with errors that are new in every epoch; those of its model (walls, floor, lamps that lean)
are not, nor are those of a heading that without wheels it can only guess at, or of the distance from a row of lamps.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3, symmetric
from estimator.result import LightsResult

TRUST = 2.0
"""By how much the variance of a position from light is raised always: errors of the light model hang together farther
than it knows."""
BENT, BENT_MOST = 6.0, 2.5
"""By how much more for each unit of `LightsResult.bent`, up to a most. In 295 starts under lamps that are no row the
squared deviation of the place, half of it a dimension, was at most 3.2 to 6.8 in 95 of 100 moments with lamps bent as
usual (3.0 would be right), 6 to 11 up to 0.5 beyond, 7 to 18 up to 1.5 and 20 to 41 beyond: with as many lamps in view,
and the same covariance."""
YOUNG, YOUNG_M = 3.0, 0.5
"""By how much more at the start at least, fading over so much way, m: the heading is still being found."""
IN_ROW, IN_ROW_M, BESIDE_M = 5.0, 1.0, 1.0
"""And by how much more under one row of lamps, those less than the last off a line: they fit anywhere across."""
UNGUIDED = 1.5
"""By how much that variance is raised further where no wheels tell `lights` how the robot moves."""
ANY_HEADING = math.pi**2 / 3.0
"""Variance of a heading that may be any, rad^2."""


def doubted(lights: LightsResult, known_m: float, wheels: bool = True, in_row: float = 0.0) -> LightsResult:
    """The lights' result with less trust in it; no heading is less certain than one that may be any.

    ``known_m``: way since light last began to find its place. ``wheels``: it is told how the robot moves. ``in_row``:
    how much of a row the lamps in use are, or were of late, 0 to 1 (`collinear_lamps.Lately.narrow` of `BESIDE_M`).
    """
    P, factor = doubted_covariance(lights, known_m, wheels, in_row)
    return replace(lights, covariance=P, gained=lights.gained / factor)


def doubted_covariance(
    lights: LightsResult, known_m: float, wheels: bool = True, in_row: float = 0.0
) -> tuple[Array, float]:
    """Its covariance alone (3x3; m^2, rad^2; map axes), and by how much it has been raised."""
    bent = lights.bent if lights.bent <= BENT_MOST else BENT_MOST  # also what is no number
    factor = TRUST + max(BENT * bent, YOUNG * math.exp(-known_m / YOUNG_M))
    factor += in_row * IN_ROW * math.exp(-known_m / IN_ROW_M)
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

    ``more``: covariance (3, 3; m, m, rad; survey axes) that is added, see `collinear_lamps.doubt` and
    `collinear_lamps.Lately`.
    """
    if not more.any():
        return lights
    P = lights.covariance + more
    keep = invert3(P) @ lights.covariance
    made = keep.T @ lights.gained_by  # what is told must go with what it weighs: else each wander across adds up
    return replace(lights, covariance=P, gained=symmetric(keep @ lights.gained @ keep.T), gained_by=made)
