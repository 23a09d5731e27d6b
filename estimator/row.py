"""Lamps that stand in one row: what they do not tell.

The distance from the row they tell only by how weak they are all together, which is what is known least, and not on
which side of it the robot is; a heading they tell by how that distance changes.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.lights_catalogue import Catalogue
from estimator.linear3 import add_turned
from estimator.records import Array

ROW_M, ACROSS_M, ACROSS_RAD = 0.5, 1.0, 0.2
"""Lamps less than the first off a line are a row; the second is allowed for across it, the third for the heading."""

KNOWN = 4096
"""So many sets of lamps are remembered."""


def doubt(catalogue: Catalogue, lamps: frozenset[int]) -> Array:
    """Covariance (3, 3; m, m, rad in the survey's axes) to be added to a pose that these lamps have told.

    Nothing where none of them is known. It is not to be changed by who gets it.
    """
    known = catalogue.doubts.get(lamps)
    if known is None:
        known = np.zeros((3, 3))
        at = [(lamp.x, lamp.y) for lamp in map(catalogue.by_id.get, sorted(lamps)) if lamp is not None]
        if at:
            along, across, angle = spread(at)  # one lamp is a row both ways
            wide, narrow = (math.exp(-variance / ROW_M**2) for variance in (along, across))
            add_turned(angle, np.array((ACROSS_M**2 * wide, ACROSS_M**2 * narrow, ACROSS_RAD**2 * narrow)), known)
        if len(catalogue.doubts) >= KNOWN:
            catalogue.doubts.clear()
        catalogue.doubts[lamps] = known
    return known


def spread(at: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Variances of points along and across the line that fits them best, and that line's direction."""
    n = len(at)
    x, y = sum(p[0] for p in at) / n, sum(p[1] for p in at) / n
    xx, yy = sum((p[0] - x) ** 2 for p in at) / n, sum((p[1] - y) ** 2 for p in at) / n
    xy = sum((p[0] - x) * (p[1] - y) for p in at) / n
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return mean + half, max(mean - half, 0.0), 0.5 * math.atan2(2.0 * xy, xx - yy)
