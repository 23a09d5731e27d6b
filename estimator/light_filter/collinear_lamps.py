"""Collinear lamps: extra covariance and minimum variances for the directions they cannot observe.

Lamps on one line determine the distance from it only by their common RSS, the least certain quantity. They do not
determine the side of the line. They determine the heading only by the change of that distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimator.light_filter.lamp_catalogue import Catalogue
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import add_turned

ROW_M, ACROSS_M, ACROSS_RAD = 0.5, 1.0, 0.2
"""Distance (m) from a line within which lamps are collinear; extra sigma across the line, m; extra sigma of the
heading, rad.
"""

SIDE_M, SIDE_RAD = 0.5, 0.2
"""Minimum sigma across the line (m) and of the heading (rad) that no number of epochs of collinear lamps reduces.
Beside walls the heading was wrong by 15 deg and more.
"""

SLIGHT, LASTING_S, LASTING_M = 0.1, 1.0, 0.15
"""Collinearity below which lamps are not collinear; time (s) and path length (m) below which the limits do not apply.
Other lamps may be hidden for a moment only. Over a short path the earlier lamps still determine the pose.
"""

BENT_M = 0.7
"""Position sigma (m) above which an error of position along collinear lamps carries no information about the heading.
The wrong heading that caused it has changed since.
"""

SURE = 3.0
"""Significance, in standard deviations, below which an offset may be zero."""

FORGOTTEN_M, EPOCH_M = 0.1, 0.05
"""Path length (m) with other lamps over which the variance left by collinear lamps fades by a factor of e; largest part
of it in one epoch (m).
"""

KNOWN = 4096
"""Most sets of lamps that are cached."""


def doubt(catalogue: Catalogue, lamps: frozenset[int]) -> Array:
    """Extra covariance (3, 3; m, m, rad; survey axes) of a pose determined by these lamps.

    Zero if none of them is in the catalogue. The result is cached and must not be modified.
    """
    known = catalogue.doubts.get(lamps)
    if known is None:
        known = np.zeros((3, 3))
        at = [(lamp.x, lamp.y) for lamp in map(catalogue.by_id.get, sorted(lamps)) if lamp is not None]
        if at:
            along, across, angle = spread(at)  # a single lamp is collinear both ways
            wide, narrow = (math.exp(-variance / ROW_M**2) for variance in (along, across))
            add_turned(angle, np.array((ACROSS_M**2 * wide, ACROSS_M**2 * narrow, ACROSS_RAD**2 * narrow)), known)
        if len(catalogue.doubts) >= KNOWN:
            catalogue.doubts.clear()
        catalogue.doubts[lamps] = known
    return known


@dataclass(slots=True, eq=False)
class Lately:
    """Extra covariance that collinear lamps leave behind; initial state ``Lately()``.

    The first lamp beside the line does not correct position and heading errors that collinear lamps have caused.
    Example: a pose was 4 deg off with sigma 2.9 deg, its light heading 49 deg off. It accepted the information of one
    such epoch, and was 8 deg off with sigma 1.6 deg.

    Attributes:
        left: covariance (3, 3; m, m, rad; survey axes) to be added to the light pose now. It is that of the present
            lamps, or of the recent ones where that is larger.
        usual: mean over the path with lamps, with exponential weights; None before the first. way: path length then, m.
    """

    left: Array = field(default_factory=lambda: np.zeros((3, 3)))
    usual: Array | None = None
    way: float = 0.0

    def take(self, more: Array, way: float) -> None:
        """Update with the extra covariance of an epoch's lamps (see `doubt`) at a path length (m).

        Path length without light does not count as path with other lamps: one epoch counts for at most `EPOCH_M`.
        """
        keep = math.exp(-min(way - self.way, EPOCH_M) / FORGOTTEN_M)
        self.usual, self.way = more if self.usual is None else keep * self.usual + (1.0 - keep) * more, way
        self.left = more if more.trace() >= self.usual.trace() else self.usual

    def narrow(self, off_m: float) -> float:
        """Collinearity of the present or recent lamps, 0 to 1, at a distance scale ``off_m`` from the line, m."""
        return math.pow(max(float(self.left[2, 2]), 0.0) / ACROSS_RAD**2, (ROW_M / off_m) ** 2)


@dataclass(slots=True, eq=False)
class Under:
    """Collinearity of the lamps in use over time; initial state ``Under()``.

    Attributes:
        t: instant since which they are collinear, inf: they are not. at: (2,) dead-reckoned position then, m.
        far: largest distance from there since, m; inf: only collinear lamps have determined the pose.
        P: (3, 3; m, m, rad; survey axes) covariance of the pose at that instant.
        told: lamps that are not collinear, or the operator, have determined the pose before.
    """

    t: float = math.inf
    at: Array = field(default_factory=lambda: np.zeros(2))
    far: float = math.inf
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))
    told: bool = False

    def take(self, t: float, narrow: float, at: Array, P: Array) -> None:
        """Update at ``t`` with two or more lamps in use.

        ``narrow``: their collinearity; ``at``, ``P``: dead-reckoned position and covariance of the pose. Fewer lamps
        must not be passed in. They would end the collinear state, and it would restart with its own result as the
        earlier pose.
        """
        if narrow <= SLIGHT:
            self.t, self.told = math.inf, True
            return
        if math.isinf(self.t):
            self.t, self.at, self.P, self.far = t, at.copy(), P.copy(), 0.0 if self.told else math.inf
        self.far = max(self.far, float(np.hypot(*(at - self.at))))

    def lasts(self, t: float) -> bool:
        """Whether the lamps have been collinear for longer than a moment."""
        return t - self.t >= LASTING_S

    def least(self, angle: float) -> tuple[float, float]:
        """Minimum variances across a direction (m^2) and of the heading (rad^2) under collinear lamps."""
        if self.far >= LASTING_M:
            return SIDE_M**2, SIDE_RAD**2
        return min(SIDE_M**2, across(angle, self.P)), min(SIDE_RAD**2, float(self.P[2, 2]))


def across(angle: float, P: Array) -> float:
    """Variance (m^2) of a position across a direction (rad)."""
    nx, ny = -math.sin(angle), math.cos(angle)
    return float(nx * nx * P[0, 0] + 2.0 * nx * ny * P[0, 1] + ny * ny * P[1, 1])


def shape(catalogue: Catalogue, lamps: frozenset[int]) -> tuple[float, float]:
    """Collinearity of lamps (1: on one line; 0: none, or fewer than two known), and direction of the line, rad."""
    at = [(lamp.x, lamp.y) for lamp in map(catalogue.by_id.get, sorted(lamps)) if lamp is not None]
    if len(at) < 2:
        return 0.0, 0.0
    _, across, angle = spread(at)
    return math.exp(-2.0 * across / ROW_M**2), angle


def several(catalogue: Catalogue, lamps: frozenset[int]) -> bool:
    """Whether two or more of these lamps are in the catalogue."""
    return sum(lamp in catalogue.by_id for lamp in lamps) > 1


def loosen(narrow: float, angle: float, P: Array, least: tuple[float, float] = (SIDE_M**2, SIDE_RAD**2)) -> None:
    """Raise the covariance of a pose to the minimum that collinear lamps allow, in place.

    The apparent distance from the line has the same error in every epoch (walls beside it, common gain). So has the
    heading. Averaged twenty times a second it would soon seem certain, and be wrong along the next line.

    Args:
        narrow: collinearity of the lamps in use.
        angle: direction of the line, rad; see `shape`.
        P: covariance, its first three rows and columns those of the pose in the survey's axes; changed in place.
        least: variances across it (m^2) and of the heading (rad^2), see `Under.least`.
    """
    nx, ny = -math.sin(angle), math.cos(angle)
    lacks = narrow * least[0] - across(angle, P)
    if lacks > 0.0:
        P[0, 0] += lacks * nx * nx
        P[0, 1] += lacks * nx * ny
        P[1, 0] = P[0, 1]
        P[1, 1] += lacks * ny * ny
    P[2, 2] += max(0.0, narrow * least[1] - P[2, 2])


def straighten(P: Array, X: Array) -> tuple[Array, Array]:
    """Without odometry: drop the covariance between position and heading where the position is uncertain (`BENT_M`).

    Args:
        P: covariance (3, 3) of the pose; not changed.
        X: its covariance (3, 3) with another error; not changed.
    """
    if P[0, 0] + P[1, 1] <= BENT_M**2:
        return P, X
    P, X = P.copy(), X.copy()
    for A in (P, X):
        A[2, :2] = A[:2, 2] = 0.0
    return P, X


def sure_part(off: Array, P: Array) -> tuple[float, float]:
    """Significant distance (m) and turn (rad) by which a pose is off, given the covariance ``P``.

    The distance counts only along those axes of the uncertainty on which it is significant. A position 1.4 m off across
    the line and half a metre along it is half a metre off.

    Args:
        off: x, y, yaw; m and rad.
        P: covariance (3, 3) of the measured pose, in the same axes.
    """
    variances, axes = np.linalg.eigh(P[:2, :2])
    apart = axes.T @ off[:2]
    sure = apart[apart * apart > SURE * SURE * variances]
    turn = abs(float(off[2]))
    return float(np.linalg.norm(sure)), turn if turn > SURE * math.sqrt(P[2, 2]) else 0.0


def spread(at: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Variances of points along and across their best-fitting line, and the direction of that line (rad)."""
    n = len(at)
    x, y = sum(p[0] for p in at) / n, sum(p[1] for p in at) / n
    xx, yy = sum((p[0] - x) ** 2 for p in at) / n, sum((p[1] - y) ** 2 for p in at) / n
    xy = sum((p[0] - x) * (p[1] - y) for p in at) / n
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return mean + half, max(mean - half, 0.0), 0.5 * math.atan2(2.0 * xy, xx - yy)
