"""Covariance inflation of the light position before it enters the pose.

The light filter assumes errors that are independent in every epoch. Errors of its model (walls, ground, lamp tilt) are
correlated. So are errors of the heading without odometry, and of the distance from collinear lamps.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3, symmetric
from estimator.result import LightsResult

TRUST = 2.0
"""Minimum inflation of the variance: errors of the light model are correlated over longer times than it assumes."""
BENT, BENT_MOST = 6.0, 2.5
"""Additional inflation per unit of `LightsResult.bent`, and its largest value in use.

It follows from 295 starts under lamps that are not collinear. The normalised squared deviation of the position (half of
it a dimension) had these 95 % limits. With usual gain consistency: 3.2 to 6.8 (3.0 would be right). Up to 0.5 above: 6
to 11. Up to 1.5: 7 to 18. Beyond: 20 to 41. The number of lamps in view, and the covariance, were the same.
"""
YOUNG, YOUNG_M = 3.0, 0.5
"""Minimum additional inflation at the start and the path length (m) of its decay: the heading still converges."""
IN_ROW, IN_ROW_M, BESIDE_M = 5.0, 1.0, 1.0
"""Additional inflation under collinear lamps, its decay length (m), and the largest distance (m) off their line.

Across that line every position fits.
"""
UNGUIDED = 1.5
"""Factor on that variance where the light filter has no odometry."""
ANY_HEADING = math.pi**2 / 3.0
"""Variance of an unknown heading, rad^2."""


def doubted(lights: LightsResult, known_m: float, wheels: bool = True, in_row: float = 0.0) -> LightsResult:
    """The light solution with inflated covariance; the heading variance is at most that of an unknown heading.

    ``known_m``: path length since light last began to find its position. ``wheels``: the light filter has odometry.
    ``in_row``: collinearity of the lamps in use, now or recently, 0 to 1 (`collinear_lamps.Lately.narrow` of
    `BESIDE_M`).
    """
    P, factor = doubted_covariance(lights, known_m, wheels, in_row)
    return replace(lights, covariance=P, gained=lights.gained / factor)


def doubted_covariance(
    lights: LightsResult, known_m: float, wheels: bool = True, in_row: float = 0.0
) -> tuple[Array, float]:
    """The inflated covariance alone (3x3; m^2, rad^2; map axes), and the inflation factor."""
    bent = lights.bent if lights.bent <= BENT_MOST else BENT_MOST  # NaN too
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
    """The light solution with unknown heading: its position then corrects the pose's heading along the path."""
    P = lights.covariance.copy()
    P[2, :2] = P[:2, 2] = 0.0
    P[2, 2] = ANY_HEADING
    keep = invert3(P) @ lights.covariance
    made = np.array((lights.gained_by[0], lights.gained_by[1], 0.0))
    return replace(lights, covariance=P, gained=symmetric(keep @ lights.gained @ keep.T), gained_by=made)


def across_the_row(more: Array, lights: LightsResult) -> LightsResult:
    """The light solution with a larger covariance across the line of collinear lamps, now or recently.

    ``more``: covariance (3, 3; m, m, rad; survey axes) that is added, see `collinear_lamps.doubt` and
    `collinear_lamps.Lately`.
    """
    if not more.any():
        return lights
    P = lights.covariance + more
    keep = invert3(P) @ lights.covariance
    made = keep.T @ lights.gained_by  # correction and weight must match, or errors across the line would accumulate
    return replace(lights, covariance=P, gained=symmetric(keep @ lights.gained @ keep.T), gained_by=made)
