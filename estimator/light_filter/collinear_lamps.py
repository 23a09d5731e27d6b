"""Lamps that stand in one row: what they do not tell.

The distance from the row they tell only by how weak they are all together, which is what is known least, and not on
which side of it the robot is; a heading they tell by how that distance changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimator.light_filter.lamp_catalogue import Catalogue
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import add_turned

ROW_M, ACROSS_M, ACROSS_RAD = 0.5, 1.0, 0.2
"""Lamps less than the first off a line are a row; the second is allowed for across it, the third for the heading."""

SIDE_M, SIDE_RAD = 0.5, 0.2
"""What no number of looks at a row makes surer than: beside walls a heading was led 15 deg astray, and more."""

SLIGHT, LASTING_S, LASTING_M = 0.1, 1.0, 0.15
"""A row by less than the first is none; nor is one that has not lasted so many seconds: other lamps are hidden for a
moment, and come to be in use again. Who has not gone so far under it knows the place by the lamps before."""

BENT_M = 0.7
"""A place less certain than that was led astray by a heading that was not what it is now, along a row of lamps: what it
is off by says nothing of that."""

SURE = 3.0
"""An offset of fewer standard deviations of what has told it may be none."""

FORGOTTEN_M, EPOCH_M = 0.1, 0.05
"""Way with other lamps over which what a row has left in place and heading fades, by a factor of e in its variance; and
how much of it one epoch can be."""

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


@dataclass(slots=True, eq=False)
class Lately:
    """What a row leaves behind; start with ``Lately()``.

    Place and heading that a row has led astray are not put right by the first lamp beside it. A pose 4 deg off and sure
    to 2.9 took what one epoch with such a lamp seemed to add to a heading 49 deg off, and was 8 deg off, sure to 1.6.

    Attributes:
        left: covariance (3, 3; m, m, rad; survey axes) to be added to what lamps tell now: by the lamps themselves, or
            by those of the way of late where that is more.
        usual: mean over the way with lamps, weighted by how long ago; None before the first. way: driven until then, m.
    """

    left: Array = field(default_factory=lambda: np.zeros((3, 3)))
    usual: Array | None = None
    way: float = 0.0

    def take(self, more: Array, way: float) -> None:
        """Take in the doubt about the lamps of an epoch (see `doubt`), after so much way (m).

        Way in the dark is none with other lamps: no epoch stands for more than `EPOCH_M`.
        """
        keep = math.exp(-min(way - self.way, EPOCH_M) / FORGOTTEN_M)
        self.usual, self.way = more if self.usual is None else keep * self.usual + (1.0 - keep) * more, way
        self.left = more if more.trace() >= self.usual.trace() else self.usual

    def narrow(self, off_m: float) -> float:
        """How much of a row the lamps are, or were of late, 0 to 1: where they are less than so far off a line."""
        return math.pow(max(float(self.left[2, 2]), 0.0) / ACROSS_RAD**2, (ROW_M / off_m) ** 2)


@dataclass(slots=True, eq=False)
class Under:
    """The row that lamps in use have become; start with ``Under()``.

    Attributes:
        t: since when, inf: they are none. at: (2,) where the robot was then, of its dead-reckoned way, m. far: how far
            it has been from there since, m; inf: nothing but a row has told the pose. P: (3, 3; m, m, rad; survey axes)
            what was known of the pose then.
        told: lamps that are no row, or a person, have told the pose before.
    """

    t: float = math.inf
    at: Array = field(default_factory=lambda: np.zeros(2))
    far: float = math.inf
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))
    told: bool = False

    def take(self, t: float, narrow: float, at: Array, P: Array) -> None:
        """At ``t`` two lamps or more are in use, and ``narrow`` a row; place and covariance of the pose are these.

        Fewer tell nothing of a row, nor that it is over: it would begin anew, with what it has told itself.
        """
        if narrow <= SLIGHT:
            self.t, self.told = math.inf, True
            return
        if math.isinf(self.t):
            self.t, self.at, self.P, self.far = t, at.copy(), P.copy(), 0.0 if self.told else math.inf
        self.far = max(self.far, float(np.hypot(*(at - self.at))))

    def lasts(self, t: float) -> bool:
        """Whether they are more than a row for a moment."""
        return t - self.t >= LASTING_S

    def least(self, angle: float) -> tuple[float, float]:
        """Variances across a direction (m^2) and of the heading (rad^2) that looks at the row make no smaller."""
        if self.far >= LASTING_M:
            return SIDE_M**2, SIDE_RAD**2
        return min(SIDE_M**2, across(angle, self.P)), min(SIDE_RAD**2, float(self.P[2, 2]))


def across(angle: float, P: Array) -> float:
    """Variance of a place across a direction, rad."""
    nx, ny = -math.sin(angle), math.cos(angle)
    return float(nx * nx * P[0, 0] + 2.0 * nx * ny * P[0, 1] + ny * ny * P[1, 1])


def shape(catalogue: Catalogue, lamps: frozenset[int]) -> tuple[float, float]:
    """How much lamps are a row (1: on one line; 0: not at all, or fewer than two are known), and its direction, rad."""
    at = [(lamp.x, lamp.y) for lamp in map(catalogue.by_id.get, sorted(lamps)) if lamp is not None]
    if len(at) < 2:
        return 0.0, 0.0
    _, across, angle = spread(at)
    return math.exp(-2.0 * across / ROW_M**2), angle


def several(catalogue: Catalogue, lamps: frozenset[int]) -> bool:
    """Whether two or more of these are known."""
    return sum(lamp in catalogue.by_id for lamp in lamps) > 1


def loosen(narrow: float, angle: float, P: Array, least: tuple[float, float] = (SIDE_M**2, SIDE_RAD**2)) -> None:
    """Keep a pose that a row of lamps has told from becoming surer across it than one look at them makes it.

    How far the lamps seem from the row is the same mistake in every epoch (walls beside, a common gain), and with it
    the heading: believed twenty times a second it is soon held for certain, and is a mistake along the next row.

    Args:
        narrow: how much the lamps in use are a row.
        angle: its direction, rad; see `shape`.
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
    """Of a place that is hardly known, without wheels: it says nothing of the heading, nor the heading of the place.

    Args:
        P: covariance (3, 3) of the place; not changed.
        X: its covariance (3, 3) with another error; not changed.
    """
    if P[0, 0] + P[1, 1] <= BENT_M**2:
        return P, X
    P, X = P.copy(), X.copy()
    for A in (P, X):
        A[2, :2] = A[:2, 2] = 0.0
    return P, X


def sure_part(off: Array, P: Array) -> tuple[float, float]:
    """Distance (m) and turn (rad) by which a pose is off, as far as what told the pose can be sure of it.

    Of a distance only what lies along those axes of its uncertainty on which it is beyond doubt: a place that is 1.4 m
    across the row and half a metre along it is half a metre away.

    Args:
        off: x, y, yaw; m and rad.
        P: covariance (3, 3) of what has told the pose, in the same axes.
    """
    variances, axes = np.linalg.eigh(P[:2, :2])
    apart = axes.T @ off[:2]
    sure = apart[apart * apart > SURE * SURE * variances]
    turn = abs(float(off[2]))
    return float(np.linalg.norm(sure)), turn if turn > SURE * math.sqrt(P[2, 2]) else 0.0


def spread(at: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Variances of points along and across the line that fits them best, and that line's direction."""
    n = len(at)
    x, y = sum(p[0] for p in at) / n, sum(p[1] for p in at) / n
    xx, yy = sum((p[0] - x) ** 2 for p in at) / n, sum((p[1] - y) ** 2 for p in at) / n
    xy = sum((p[0] - x) * (p[1] - y) for p in at) / n
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return mean + half, max(mean - half, 0.0), 0.5 * math.atan2(2.0 * xy, xx - yy)
